//! Connects the coordinator to the server's state.

use std::collections::BTreeSet;

use ubimap_protocol::{
    message::{EventCode, Waypoint},
    time::Instant,
    units::RobotId,
};

use super::{
    command::Command,
    coordination::{
        Coordinator, DrivableFloor, Errand, GoalError, Notice, Settings, Situation, Unexplored,
        Whereabouts,
    },
    snapshot::Snapshot,
};

/// Decides where robots drive.
#[derive(Debug)]
pub(super) struct Dispatch {
    coordinator: Coordinator,
    /// Robots that may explore, including those that the coordinator does not know yet.
    explorers: BTreeSet<RobotId>,
    /// Robots that were told to stop.
    held: BTreeSet<RobotId>,
}

impl Dispatch {
    pub(super) fn new(settings: Settings) -> Self {
        let (explorers, held) = (BTreeSet::new(), BTreeSet::new());
        Self { coordinator: Coordinator::new(settings), explorers, held }
    }

    /// Keeps robots on a floor.
    pub(super) fn keep_to(&mut self, floor: DrivableFloor) {
        self.coordinator.keep_to(floor);
    }

    /// Lets a robot explore, or stops it from exploring.
    pub(super) fn explore(&mut self, robot: RobotId, explores: bool) {
        if explores {
            self.explorers.insert(robot);
        } else {
            self.explorers.remove(&robot);
            self.coordinator.set_exploring(robot, false);
        }
    }

    /// Notes that a robot was told to stop, which ends its errand, or that it may drive again.
    pub(super) fn hold(&mut self, robot: RobotId, held: bool) {
        if held {
            self.held.insert(robot);
            self.coordinator.end_errand(robot);
        } else {
            self.held.remove(&robot);
        }
    }

    /// Sends a robot to a position in `map`, in metres.
    pub(super) fn goal(
        &mut self,
        robot: RobotId,
        [x, y]: [f64; 2],
        now: Instant,
    ) -> Result<(), GoalError> {
        self.coordinator.goal(robot, x, y, now)
    }

    /// What a robot is doing.
    pub(super) fn errand(&self, robot: RobotId) -> Option<Errand> {
        self.coordinator.errand(robot)
    }

    /// What is left to explore.
    pub(super) fn unexplored(&self) -> Vec<Unexplored> {
        self.coordinator.unexplored()
    }

    /// Notes that a robot has booted.
    pub(super) fn booted(&mut self, robot: RobotId) {
        self.coordinator.booted(robot);
    }

    /// Passes on an event that a robot reported.
    pub(super) fn event(&mut self, robot: RobotId, code: EventCode, now: Instant) {
        self.coordinator.event(robot, code, now);
    }

    pub(super) fn poll_timeout(&self) -> Instant {
        self.coordinator.poll_timeout()
    }

    /// Lets the coordinator decide if a decision is due. Returns whether it was; the caller must
    /// then drain the commands and notices. `is_reachable` says which robots can be commanded.
    pub(super) fn tick(
        &mut self,
        snapshot: &Snapshot<'_>,
        is_reachable: impl Fn(RobotId) -> bool,
        now: Instant,
    ) -> bool {
        if now < self.poll_timeout() {
            return false;
        }
        let robots = snapshot.surroundings.robots().map(|(robot, place, footprint)| {
            let obeys = is_reachable(robot) && !self.held.contains(&robot);
            let (moment, pose, is_in_view) = (place.moment, place.pose, place.is_in_view());
            Whereabouts { robot, moment, pose, is_in_view, footprint, obeys }
        });
        let robots: Vec<Whereabouts> = robots.collect();
        let obstacles = snapshot.surroundings.all_obstacles().into_iter();
        let obstacles: Vec<_> = obstacles.map(|(obstacle, _)| obstacle).collect();
        let Snapshot { fused, coverage, .. } = *snapshot;
        let situation = Situation { fused, coverage, robots: &robots, obstacles: &obstacles };
        self.coordinator.tick(&situation, now);
        for &robot in &self.explorers {
            // Unknown robots are retried at the next tick.
            let _ = self.coordinator.set_exploring(robot, true);
        }
        true
    }

    /// The next command for a robot.
    pub(super) fn poll_command(&mut self) -> Option<(RobotId, Command)> {
        let command = self.coordinator.poll_command();
        if let Some((robot, Command::Path(path))) = &command {
            match (path.waypoints.last(), self.errand(*robot)) {
                (Some(Waypoint { x, y }), Some(errand)) => log::debug!(
                    "robot {} gets a path to {:.2} m, {:.2} m: it {errand}",
                    robot.0,
                    x.metres(),
                    y.metres()
                ),
                _ => log::debug!("robot {} is to stand", robot.0),
            }
        }
        command
    }

    /// The next notice about a robot's drive.
    pub(super) fn poll_notice(&mut self) -> Option<(RobotId, Notice)> {
        self.coordinator.poll_notice()
    }
}
