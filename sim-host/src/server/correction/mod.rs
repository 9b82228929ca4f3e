//! What the server corrects in where robots are and what they draw, from their fixes and distance
//! vectors: constant errors of identifiers and sensors, found on covered ground, and poses in blind
//! ground, by a match with the map.

mod blind;
mod cure;
mod robot;

use std::collections::{BTreeMap, VecDeque};

use ubimap_protocol::{
    time::Instant,
    units::{Millimetres, Pose, RobotId},
};

use self::{
    cure::CureStep,
    robot::{Finding, RobotCorrection},
};
use super::{command::Command, session::Session, shared_map::SharedMap};
use crate::mapping::{ConstantErrors, CureRecord};

/// The corrections of all robots.
#[derive(Debug, Default)]
pub(super) struct Corrections {
    robots: BTreeMap<RobotId, RobotCorrection>,
    /// Robots whose newest distance vector has not been looked at, each once, in turn.
    waiting: VecDeque<RobotId>,
    /// Nothing is corrected, to compare.
    are_off: bool,
}

impl Corrections {
    /// Leaves constant errors as they are, and robots in blind ground without fixes.
    pub(super) fn turn_off(&mut self) {
        self.are_off = true;
    }

    /// What has been found of a robot's constant errors.
    pub(super) fn errors(&self, robot: RobotId) -> Option<&ConstantErrors> {
        self.robots.get(&robot).map(RobotCorrection::errors)
    }

    /// Takes back what an earlier life of the server has done about a robot's errors.
    pub(super) fn restore(&mut self, record: &CureRecord) {
        self.robots.insert(record.robot, RobotCorrection::of(record));
    }

    /// Takes where a camera saw a robot, and returns where it was.
    pub(super) fn fix(&mut self, robot: RobotId, captured: Instant, seen: Pose) -> Pose {
        self.robots.entry(robot).or_default().fix(captured, seen)
    }

    /// The robot whose distance vector has waited longest.
    pub(super) fn poll_waiting(&mut self) -> Option<RobotId> {
        self.waiting.pop_front()
    }

    /// Whether [`Corrections::poll_waiting`] has one.
    pub(super) fn has_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Looks at a robot's newest distance vector. Takes about a millisecond, several in blind
    /// ground.
    pub(super) fn look(
        &mut self,
        session: &mut Session,
        map: &mut SharedMap,
        resolution: Millimetres,
        now: Instant,
    ) {
        let robot = session.robot();
        let Some(vector) = session.said_mut().take_vector() else { return };
        let correction = self.robots.entry(robot).or_default();
        match correction.look(robot, &vector, (map, resolution), now) {
            Some(Finding::Fix(_)) if self.are_off => {}
            Some(Finding::Fix(fix)) => session.matched(fix),
            Some(Finding::Agreement(agree, contradict)) => map.looked(robot, agree, contradict),
            None => {}
        }
    }

    /// Takes what a robot has said: its newest distance vector is queued to be looked at, and its
    /// parameter reports advance its cure, unless something holds that up. Returns the cure's
    /// progress, if there is any.
    pub(super) fn advance(
        &mut self,
        session: &mut Session,
        map: &SharedMap,
        is_held_up: bool,
        now: Instant,
    ) -> Option<CureRecord> {
        let robot = session.robot();
        if session.said().has_vector() && !self.waiting.contains(&robot) {
            self.waiting.push_back(robot);
        }
        if is_held_up {
            return None;
        }
        let correction = self.robots.entry(robot).or_default();
        let report = session.said_mut().take_own_parameters();
        let step = match report.and_then(|report| correction.reported(&report, now)) {
            None if self.are_off => None,
            None => correction.poll_cure(map.next_epoch(robot), now),
            answered => answered,
        };
        let (first_epoch, is_over) = match step? {
            CureStep::Tell(command) => {
                session.command(Command::Parameter(command));
                return None;
            }
            CureStep::IdentifierCorrected | CureStep::SensorCorrected => {
                (map.first_epoch(robot), false)
            }
            CureStep::GiveUp => (map.first_epoch(robot), true),
            CureStep::Retire(epoch) => (epoch, true),
        };
        let cured = correction.errors().cured();
        Some(CureRecord { robot, cured, first_epoch, is_over })
    }
}
