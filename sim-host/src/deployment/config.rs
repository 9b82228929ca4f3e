//! What a deployment is made of, and what its earlier lives have left.

use ubimap_protocol::{
    tile::Epoch,
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::registry::Registry;
use crate::{
    camera::Calibration,
    mapping::{CameraTile, CureRecord, TileRecord},
    server::coordination::Settings,
};

/// From the newest moment that a store knows to the beginning of the next life: records carry whole
/// seconds, so two lives never share one.
const LIFE_GAP: Duration = Duration::from_secs(1);

/// What a deployment is made of.
#[derive(Clone, Debug)]
pub struct Config {
    /// The side of the map's cells. Robots with another one are refused.
    pub resolution: Millimetres,
    /// The cameras whose frames it is given, by their numbers. Observations need none.
    pub cameras: Vec<Calibration>,
    /// The robots, and the markers by which cameras know them.
    pub registry: Registry,
    /// How robots are told where to drive; `None` leaves them alone.
    pub coordination: Option<Settings>,
    /// Whether constant errors of robots are corrected, and robots in blind ground get fixes.
    pub corrects_errors: bool,
    /// Whether [`Deployment::sightings`](super::Deployment::sightings) keeps every sighting of a
    /// robot, 32 bytes each: for reports about runs that end.
    pub keeps_sightings: bool,
}

impl Config {
    /// No cameras, no registered robots, no coordination; errors are corrected.
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
    /// The epoch of the server's layers: higher than in all earlier lives.
    pub epoch: Epoch,
    /// What earlier lives have kept, if this one keeps anything either.
    pub kept: Option<Kept>,
}

impl Life {
    /// A life that keeps nothing.
    pub fn new(epoch: Epoch) -> Self {
        Self { epoch, kept: None }
    }

    /// When it begins by the server's clock, which goes on from life to life.
    pub(super) fn begins(&self) -> Instant {
        match self.kept.as_ref().map(|kept| kept.clock) {
            None | Some(Instant(0)) => Instant(0),
            Some(last) => last + LIFE_GAP,
        }
    }
}

impl Default for Life {
    /// The first one, which keeps nothing.
    fn default() -> Self {
        Self::new(Epoch(1))
    }
}

/// What earlier lives have kept.
#[derive(Clone, Debug, Default)]
pub struct Kept {
    /// The newest moment of the server's clock that is known.
    pub clock: Instant,
    /// States of robots' tiles, the epochs of each tile in their order.
    pub tiles: Vec<(RobotId, TileRecord)>,
    /// What cameras have seen.
    pub camera_tiles: Vec<CameraTile>,
    /// How far the cures of robots have come.
    pub cures: Vec<CureRecord>,
}
