//! Corrections from robots' fixes and distance vectors: on covered ground, constant errors of
//! identifiers and sensors are estimated; in blind ground, robots are followed by what they see, and
//! matched with the map. What all of them saw together tells where they were, and moves what they have
//! drawn.

mod blind;
mod booted;
mod cure;
mod drift;
mod odometry;
mod robot;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use ubimap_protocol::{
    tile::Epoch,
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};

use self::{
    cure::CureStep,
    robot::{Finding, RobotCorrection},
};
use super::{command::Command, session::Session, shared_map::SharedMap, surroundings::Place};
use crate::mapping::{ConstantErrors, CureRecord, Placement, trajectories::Trajectories};

/// Interval at which the robots' trajectories are solved.
const SOLVING_INTERVAL: Duration = Duration::from_secs(1);

/// The corrections of all robots.
#[derive(Debug, Default)]
pub(super) struct Corrections {
    robots: BTreeMap<RobotId, RobotCorrection>,
    /// Robots with an unprocessed distance vector, in order of arrival, each once.
    waiting: VecDeque<RobotId>,
    /// Whether the corrections are turned off, for comparisons.
    are_off: bool,
    trajectories: Trajectories,
    /// When the trajectories are next solved.
    next_solving: Instant,
    /// The robots that the map does not follow yet, and those of whose corrections some may be needed no longer.
    unplaced: BTreeSet<RobotId>,
    unthinned: BTreeSet<RobotId>,
}

impl Corrections {
    /// Turns off the correction of constant errors and the fixes in blind ground.
    pub(super) fn turn_off(&mut self) {
        self.are_off = true;
    }

    /// The estimates of a robot's constant errors.
    pub(super) fn errors(&self, robot: RobotId) -> Option<&ConstantErrors> {
        self.robots.get(&robot).map(RobotCorrection::errors)
    }

    /// The first epoch of a robot's new tiles, from when the robot is told it until its earlier
    /// epochs are void.
    pub(super) fn retiring(&self, robot: RobotId) -> Option<Epoch> {
        self.robots.get(&robot)?.retiring()
    }

    /// Forgets a robot that is gone and has drawn nothing.
    pub(super) fn forget(&mut self, robot: RobotId) {
        self.robots.remove(&robot);
        self.trajectories.forget(robot);
        self.waiting.retain(|waiting| *waiting != robot);
    }

    /// Restores a robot's corrections from an earlier run of the server.
    pub(super) fn restore(&mut self, record: &CureRecord) {
        self.robots.insert(record.robot, RobotCorrection::of(record));
    }

    /// Restores where a robot was in an earlier run of the server.
    pub(super) fn restore_placement(&mut self, robot: RobotId, placement: &Placement) {
        self.trajectories.restore(robot, placement.clone());
    }

    /// Adds a camera fix of a robot; returns the corrected pose.
    pub(super) fn fix(&mut self, robot: RobotId, captured: Instant, seen: Pose) -> Pose {
        self.robots.entry(robot).or_default().fix(captured, seen)
    }

    /// Seeks a robot that has booted around the place where it was.
    pub(super) fn seek(&mut self, robot: RobotId, about: &Place) {
        self.robots.entry(robot).or_default().seek(about);
    }

    /// Whether a robot has booted out of view and was not found yet.
    pub(super) fn is_sought(&self, robot: RobotId) -> bool {
        self.robots.get(&robot).is_some_and(RobotCorrection::is_sought)
    }

    /// The robot whose distance vector has waited longest.
    pub(super) fn poll_waiting(&mut self) -> Option<RobotId> {
        self.waiting.pop_front()
    }

    /// Whether [`Corrections::poll_waiting`] would return a robot.
    pub(super) fn has_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Processes a robot's newest distance vector. Cost: about 1 ms, several in blind ground.
    pub(super) fn look(
        &mut self,
        session: &mut Session,
        map: &mut SharedMap,
        resolution: Millimetres,
        now: Instant,
    ) {
        let robot = session.robot();
        let Some(vector) = session.said_mut().take_vector() else { return };
        map.look_along(&vector, resolution);
        let correction = self.robots.entry(robot).or_default();
        let trajectories = (!self.are_off).then_some(&mut self.trajectories);
        let finding = correction.look(robot, &vector, (map, resolution), now, trajectories);
        match finding {
            Some(Finding::Fix(_)) if self.are_off => {}
            Some(Finding::Fix(fix)) => session.matched(fix),
            Some(Finding::Agreement(agree, contradict)) => map.looked(robot, agree, contradict),
            None => {}
        }
    }

    /// Finds out where the robots were, and moves what they have drawn, in parts of some 10 ms.
    pub(super) fn follow(&mut self, map: &mut SharedMap, resolution: Millimetres, now: Instant) {
        let Self { trajectories, .. } = self;
        // With more to match than there is time for, the rest goes on nevertheless.
        let is_overdue = self.next_solving + SOLVING_INTERVAL <= now;
        if let Some(moved) = self.unplaced.pop_first() {
            map.place(moved, trajectories.placement(moved, resolution), resolution);
        } else if let Some(robot) = self.unthinned.pop_first() {
            trajectories.thin(robot, &map.seconds(robot));
        } else if trajectories.is_matching() && !trajectories.is_solving() && !is_overdue {
            trajectories.advance();
        } else if trajectories.is_solving() || self.next_solving <= now {
            self.unplaced = trajectories.solve();
            if !trajectories.is_solving() {
                self.next_solving = now + SOLVING_INTERVAL;
            }
            if trajectories.take_settled() {
                self.unthinned = self.robots.keys().copied().collect();
            }
        }
    }

    /// A robot's tiles were voided, because its pose or its sensor's was wrong: so is the ground that it saw.
    pub(super) fn void(&mut self, robot: RobotId, map: &mut SharedMap, resolution: Millimetres) {
        self.trajectories.void_ground(robot);
        map.place(robot, self.trajectories.placement(robot, resolution), resolution);
    }

    /// The deadline for the next call of [`Corrections::follow`]; `None` if what robots have drawn is where it belongs.
    pub(super) fn poll_follow(&self, now: Instant) -> Option<Instant> {
        let Self { trajectories, unplaced, unthinned, .. } = self;
        let is_busy = trajectories.is_matching() || trajectories.is_solving();
        let is_due = is_busy || !unplaced.is_empty() || !unthinned.is_empty();
        let solving = trajectories.is_unsolved().then_some(self.next_solving);
        is_due.then_some(now).into_iter().chain(solving).min()
    }

    /// Queues the robot's newest distance vector for processing, and advances its cure, unless
    /// `is_held_up`: then the cure's last progress is not on disk yet. Returns the new progress to
    /// store, if any.
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
