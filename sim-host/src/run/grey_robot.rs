//! A simulated robot whose sensor is a grey camera: it segments its pictures onboard, and maps and
//! drives by the distances (Ahmed et al.).

use std::num::NonZero;

use ubimap_agent::{
    Bounds, Config, ConfigError, Memory, Robot,
    drive::{BoundaryFollower, BoundaryWalk, DriveCommand, Driving},
    sense::{COLUMNS, FloorConfig, ScaleCurve, floor_distances, open_floor_readings},
};
use ubimap_protocol::{time::Instant, units::Pose};

use super::heap::Heap;

/// What a robot with a grey camera needs beside its configuration.
#[derive(Clone, Copy, Debug)]
pub struct Sight {
    /// From pixels of free floor to millimetres.
    pub curve: ScaleCurve,
    /// Whether the robot follows boundaries by its pictures alone (Ahmed 3), instead of the server's paths.
    pub follows_boundaries: bool,
}

impl Sight {
    /// A robot's configuration with what follows from this sight.
    pub fn configured<D>(&self, config: Config<D>) -> Config<D> {
        let (_, far) = self.curve.far();
        let bounds = Bounds { max_range: far as u16, ..config.bounds };
        Config { near: NonZero::new(self.curve.near() as u16), bounds, ..config }
    }
}

/// A robot with a grey camera.
pub(super) struct GreyRobot<'b> {
    pub(super) robot: Robot<'b, Option<Driving>>,
    curve: ScaleCurve,
    walk: Option<BoundaryWalk>,
    /// The walk's command when the clock was last told.
    command: DriveCommand,
}

impl<'b> GreyRobot<'b> {
    /// A robot that has just booted.
    pub(super) fn new(
        config: Config<Option<Driving>>,
        memory: &'b mut Memory<Heap, Option<Driving>>,
        sight: Sight,
    ) -> Result<Self, ConfigError> {
        let walk = || BoundaryWalk::new(BoundaryFollower::default(), config.gate);
        Ok(Self {
            robot: Robot::new(config, memory)?,
            curve: sight.curve,
            walk: sight.follows_boundaries.then(walk),
            command: DriveCommand::STAND,
        })
    }

    /// Segments a picture, and maps it unless a walk is between two stops.
    pub(super) fn look(&mut self, picture: &[u8], local: Instant) {
        let distances = match floor_distances(picture, FloorConfig::default()) {
            Ok(distances) => distances,
            Err(error) => return log::debug!("picture dropped: {error}"),
        };
        let fix = self.robot.newest_fix();
        let is_mapped = self.walk.as_mut().is_none_or(|walk| walk.look(&distances, local, fix));
        if is_mapped {
            self.scan(&distances, local);
        }
        self.timeout(local);
    }

    fn scan(&mut self, distances: &[u8; COLUMNS], local: Instant) {
        if let Err(error) =
            self.robot.scan(local, &open_floor_readings(distances, &self.curve), local)
        {
            // The robot's statistics count dropped scans.
            log::debug!("robot {}: scan dropped: {error}", self.robot.settings().robot.0);
        }
    }

    /// Passes odometry to the robot and its walk.
    pub(super) fn odometry(&mut self, pose: Pose, local: Instant) {
        self.robot.odometry(local, pose, local);
        if let Some(walk) = &mut self.walk {
            walk.odometry(pose, local);
        }
        self.timeout(local);
    }

    /// Does the work that is due.
    pub(super) fn timeout(&mut self, local: Instant) {
        self.robot.timeout(local);
        let walk = self.walk.map(|walk| walk.command(local));
        self.command = walk.unwrap_or_else(|| self.robot.command());
    }

    /// The command that the wheels follow.
    pub(super) fn command(&self) -> DriveCommand {
        self.command
    }
}
