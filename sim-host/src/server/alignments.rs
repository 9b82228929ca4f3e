//! The alignment of every robot: from its session to the map, and back.

use std::collections::{BTreeMap, VecDeque};

use ubimap_protocol::{
    time::Instant,
    units::{Millimetres, Pose, RobotId},
};

use super::{
    aligning::{Aligning, Looked, Step},
    command::Command,
    session::Session,
    shared_map::SharedMap,
};
use crate::mapping::{ConstantErrors, CureRecord};

/// By robot.
#[derive(Debug, Default)]
pub(super) struct Alignments {
    robots: BTreeMap<RobotId, Aligning>,
    /// Robots whose newest distance vector has not been looked at, each once, in turn.
    waiting: VecDeque<RobotId>,
    /// Whether constant errors are left as they are, and robots in blind ground not told where they
    /// are.
    leaves_errors: bool,
}

impl Alignments {
    pub(super) fn leave_errors(&mut self) {
        self.leaves_errors = true;
    }

    /// What has been found of a robot's constant errors.
    pub(super) fn errors(&self, robot: RobotId) -> Option<&ConstantErrors> {
        self.robots.get(&robot).map(Aligning::errors)
    }

    /// Takes back what an earlier life of the server has done about a robot's errors.
    pub(super) fn restore(&mut self, record: &CureRecord) {
        self.robots.insert(record.robot, Aligning::of(record));
    }

    /// Takes where a camera saw a robot, and returns where it was.
    pub(super) fn fix(&mut self, robot: RobotId, captured: Instant, seen: Pose) -> Pose {
        self.robots.entry(robot).or_default().fix(captured, seen)
    }

    /// The robot whose distance vector has waited longest.
    pub(super) fn poll_waiting(&mut self) -> Option<RobotId> {
        self.waiting.pop_front()
    }

    /// Whether [`Alignments::poll_waiting`] has one.
    pub(super) fn has_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Takes what a robot's newest distance vector says. Takes about a millisecond, some in blind
    /// ground.
    pub(super) fn look(
        &mut self,
        session: &mut Session,
        map: &mut SharedMap,
        resolution: Millimetres,
        now: Instant,
    ) {
        let robot = session.robot;
        let Some(vector) = session.new_vector.take() else { return };
        let aligning = self.robots.entry(robot).or_default();
        match aligning.looked(robot, &vector, (map, resolution), now) {
            Some(Looked::Fix(_)) if self.leaves_errors => {}
            Some(Looked::Fix(fix)) => session.matched(fix),
            Some(Looked::Agreement(agree, contradict)) => map.looked(robot, agree, contradict),
            None => {}
        }
    }

    /// Goes on with what a robot has said: its newest distance vector is to be looked at, and its
    /// reports are for the cures, unless something holds them up. Returns how far a cure has come, if
    /// it has.
    pub(super) fn go_on(
        &mut self,
        session: &mut Session,
        map: &SharedMap,
        holds_up: bool,
        now: Instant,
    ) -> Option<CureRecord> {
        let robot = session.robot;
        if session.new_vector.is_some() && !self.waiting.contains(&robot) {
            self.waiting.push_back(robot);
        }
        if holds_up {
            return None;
        }
        let aligning = self.robots.entry(robot).or_default();
        let report = session.own_report.take();
        let step = match report.and_then(|report| aligning.reported(&report, now)) {
            None if self.leaves_errors => None,
            None => aligning.poll(map.next_epoch(robot), now),
            answered => answered,
        };
        let (first_epoch, is_over) = match step? {
            Step::Tell(command) => {
                session.command(Command::Parameter(command));
                return None;
            }
            Step::Note => (map.first_epoch(robot), false),
            Step::GiveUp => (map.first_epoch(robot), true),
            Step::Retire(epoch) => (epoch, true),
        };
        Some(CureRecord { robot, cured: aligning.errors().cured(), first_epoch, is_over })
    }
}
