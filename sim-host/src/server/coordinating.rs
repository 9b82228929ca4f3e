//! The coordinator, joined to what the server knows.

use std::collections::BTreeSet;

use ubimap_protocol::{message::EventCode, time::Instant, units::RobotId};

use super::{
    command::Command,
    coordination::{Coordinator, Settings, Situation, Whereabouts},
    surroundings::Surroundings,
};
use crate::{mapping::ServedLayer, timing::ROBOT_UNREACHABLE};

/// Who drives where.
#[derive(Debug)]
pub(super) struct Coordinating {
    coordinator: Coordinator,
    /// Those who go where nobody has been.
    explorers: BTreeSet<RobotId>,
}

/// What the coordinator is to look at.
pub(super) struct View<'v> {
    pub(super) fused: &'v ServedLayer,
    pub(super) coverage: &'v ServedLayer,
    pub(super) surroundings: &'v Surroundings,
    /// When each robot with a session was heard last.
    pub(super) heard: &'v [(RobotId, Instant)],
}

impl Coordinating {
    pub(super) fn new(settings: Settings) -> Self {
        Self { coordinator: Coordinator::new(settings), explorers: BTreeSet::new() }
    }

    pub(super) fn coordinator(&mut self) -> &mut Coordinator {
        &mut self.coordinator
    }

    pub(super) fn explore(&mut self, robot: RobotId) {
        self.explorers.insert(robot);
    }

    pub(super) fn event(&mut self, robot: RobotId, code: EventCode, now: Instant) {
        self.coordinator.event(robot, code, now);
    }

    pub(super) fn poll_timeout(&self) -> Instant {
        self.coordinator.poll_timeout()
    }

    /// Lets the coordinator decide, if that is due. What there is to be told to whom.
    pub(super) fn tick(&mut self, view: &View<'_>, now: Instant) -> Vec<(RobotId, Command)> {
        if now < self.poll_timeout() {
            return Vec::new();
        }
        let robots = view.surroundings.robots().map(|(robot, moment, pose, footprint)| {
            let mut heard = view.heard.iter().filter(|(id, _)| *id == robot);
            let has_session = heard.any(|(_, heard)| now.since(*heard) < ROBOT_UNREACHABLE);
            Whereabouts { robot, moment, pose, footprint, has_session }
        });
        let robots: Vec<Whereabouts> = robots.collect();
        let obstacles = view.surroundings.all_obstacles();
        let (fused, coverage) = (view.fused, view.coverage);
        let situation = Situation { fused, coverage, robots: &robots, obstacles: &obstacles };
        self.coordinator.tick(&situation, now);
        for &robot in &self.explorers {
            // Whoever is not known as yet will be.
            let _ = self.coordinator.set_exploring(robot, true);
        }
        while let Some((robot, notice)) = self.coordinator.poll_notice() {
            log::debug!("robot {}: {notice:?}", robot.0);
        }
        std::iter::from_fn(|| self.coordinator.poll_command()).collect()
    }
}
