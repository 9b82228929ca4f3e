//! The configuration of a deployment, and the state stored by earlier lives (runs of the server).

use ubimap_protocol::{
    tile::{Epoch, TileId},
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::registry::Registry;
use crate::{
    camera::Calibration,
    grid::Label,
    mapping::{CameraTile, CureRecord, Placement, TileRecord},
    server::coordination::{DrivableFloor, Settings},
};

/// Gap between the last stored time and the start of the next life. Records contain whole seconds,
/// so a gap of one second keeps the times of two lives distinct.
const LIFE_GAP: Duration = Duration::from_secs(1);

/// The configuration of a deployment.
#[derive(Clone, Debug)]
pub struct Config {
    /// The side length of the map's cells. Robots with a different side length are refused.
    pub resolution: Millimetres,
    /// The cameras, indexed by the number in their frames. May be empty if only observations, and
    /// no frames, are processed.
    pub cameras: Vec<Calibration>,
    /// The robots and their markers.
    pub registry: Registry,
    /// The heights between which things block robots; lower ones are floor. `None`: from 30 mm to the
    /// height of the tallest robot, or 300 mm.
    pub obstacle_heights: Option<[Millimetres; 2]>,
    /// Settings of the coordinator, which decides where robots drive; `None` for no coordinator.
    pub coordination: Option<Settings>,
    /// The floor to which the coordinator keeps robots; `None` for all of it.
    pub floor: Option<DrivableFloor>,
    /// Where things of a class stand: how soon what is known of these places is forgotten.
    pub labels: Vec<Label>,
    /// Whether constant errors of robots are corrected, and robots in blind ground get fixes.
    pub corrects_errors: bool,
    /// Whether [`Deployment::sightings`](super::Deployment::sightings) keeps every sighting of a
    /// robot, for the reports of finite runs. Costs 32 bytes per sighting; their number is not
    /// limited.
    pub keeps_sightings: bool,
}

impl Config {
    /// A configuration without cameras, robots or coordinator, but with the correction of errors.
    pub fn new(resolution: Millimetres) -> Self {
        Self {
            resolution,
            cameras: Vec::new(),
            registry: Registry::default(),
            obstacle_heights: None,
            coordination: None,
            floor: None,
            labels: Vec::new(),
            corrects_errors: true,
            keeps_sightings: false,
        }
    }
}

/// One life of the server: from a start of the program to its end.
#[derive(Clone, Debug)]
pub struct Life {
    /// The epoch of the server's layers. It differs from life to life; the order of epochs has no
    /// meaning.
    pub epoch: Epoch,
    /// The number of the first session. It should be random: if a life repeats an epoch, robots
    /// recognise the new life by it. `None`: derived from the epoch.
    pub first_session: Option<u32>,
    /// The first salt of answers on keyed ports. It must be random. `None`: derived from the epoch;
    /// only for lives without keyed ports, and for simulations.
    pub salt: Option<u64>,
    /// The state stored by earlier lives. `None` if there is no store; then this life stores
    /// nothing either.
    pub kept: Option<Kept>,
}

impl Life {
    /// A life without a store.
    pub fn new(epoch: Epoch) -> Self {
        Self { epoch, first_session: None, salt: None, kept: None }
    }

    /// When this life begins, by the server's clock, which continues across lives.
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

/// The state stored by earlier lives.
#[derive(Clone, Debug, Default)]
pub struct Kept {
    /// The last known time of the server's clock.
    pub clock: Instant,
    /// States of robots' tiles; the epochs of each tile in ascending order.
    pub tiles: Vec<(RobotId, TileRecord)>,
    /// Robots' tiles that were damaged in the store. The robots are asked to send them again.
    pub damaged_tiles: Vec<(RobotId, TileId, Epoch)>,
    /// Tiles that cameras have seen.
    pub camera_tiles: Vec<CameraTile>,
    /// Progress of the robots' cures (corrections of their constant errors).
    pub cures: Vec<CureRecord>,
    /// What is known of where robots were.
    pub placements: Vec<(RobotId, Placement)>,
}
