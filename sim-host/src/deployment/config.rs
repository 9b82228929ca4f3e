//! The configuration of a deployment, and the state left by earlier lives.

use ubimap_protocol::{
    tile::{Epoch, TileId},
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::registry::Registry;
use crate::{
    camera::Calibration,
    mapping::{CameraTile, CureRecord, TileRecord},
    server::coordination::Settings,
};

/// Gap between the last stored time and the start of the next life. Records carry whole seconds, so
/// a second keeps two lives apart.
const LIFE_GAP: Duration = Duration::from_secs(1);

/// The configuration of a deployment.
#[derive(Clone, Debug)]
pub struct Config {
    /// The side length of the map's cells. Robots with another one are refused.
    pub resolution: Millimetres,
    /// The cameras, indexed by the number in their frames. Not needed for observations.
    pub cameras: Vec<Calibration>,
    /// The robots and their markers.
    pub registry: Registry,
    /// Settings of the coordinator that tells robots where to drive; `None`: no coordinator.
    pub coordination: Option<Settings>,
    /// Whether constant errors of robots are corrected, and robots in blind ground get fixes.
    pub corrects_errors: bool,
    /// Whether [`Deployment::sightings`](super::Deployment::sightings) keeps every sighting of a
    /// robot, for the reports of finite runs. Costs 32 bytes per sighting, without limit.
    pub keeps_sightings: bool,
}

impl Config {
    /// No cameras, robots or coordination; errors are corrected.
    pub fn new(resolution: Millimetres) -> Self {
        Self {
            resolution,
            cameras: Vec::new(),
            registry: Registry::default(),
            coordination: None,
            corrects_errors: true,
            keeps_sightings: false,
        }
    }
}

/// One life of the server: from a start of the program to its end.
#[derive(Clone, Debug)]
pub struct Life {
    /// The epoch of the server's layers; different in each life, in no order.
    pub epoch: Epoch,
    /// The number of the first session, which should be random: should a life repeat an epoch, robots
    /// notice the new one by it. `None`: it follows from the epoch.
    pub first_session: Option<u32>,
    /// What earlier lives have stored; `None` if nothing is stored, in this life either.
    pub kept: Option<Kept>,
}

impl Life {
    /// A life without a store.
    pub fn new(epoch: Epoch) -> Self {
        Self { epoch, first_session: None, kept: None }
    }

    /// The start of this life by the server's clock, which continues across lives.
    pub(super) fn begins(&self) -> Instant {
        match self.kept.as_ref().map(|kept| kept.clock) {
            None | Some(Instant(0)) => Instant(0),
            Some(last) => last + LIFE_GAP,
        }
    }
}

impl Default for Life {
    /// The first life, without a store.
    fn default() -> Self {
        Self::new(Epoch(1))
    }
}

/// What earlier lives have stored.
#[derive(Clone, Debug, Default)]
pub struct Kept {
    /// The last known time of the server's clock.
    pub clock: Instant,
    /// States of robots' tiles; the epochs of each tile in ascending order.
    pub tiles: Vec<(RobotId, TileRecord)>,
    /// Robots' tiles that were damaged in the store: the robots are asked for them again.
    pub damaged_tiles: Vec<(RobotId, TileId, Epoch)>,
    /// Tiles that cameras have seen.
    pub camera_tiles: Vec<CameraTile>,
    /// Progress of the robots' cures.
    pub cures: Vec<CureRecord>,
}
