//! A robot's configuration and its validation.

use core::{fmt, num::NonZero};

use ubimap_protocol::{
    frame::Key,
    tile::Epoch,
    time::Duration,
    units::{Pose, RobotId},
};

use super::bounds::Bounds;
use crate::{
    drive::NoDrive,
    locate::{OdometryNoise, PoseSource, UncertaintyLimit},
    map::{Gate, MAX_RADIUS, MIN_RESOLUTION, PeerMask, Policy},
    sense::{Exposure, Removal, SensorModel, SteadyLimits, Validity},
    timing::SCAN_LATE,
};

/// The configuration of a robot. The server can change part of it at run time
/// ([`Parameter`](crate::Parameter)).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config<D = NoDrive> {
    /// The robot's id, unique in a deployment.
    pub robot: RobotId,
    /// A number that should be different at each boot.
    pub boot_nonce: u32,
    /// The key of a sealed link, and the number of this boot; `None` for an open link.
    pub seal: Option<Seal>,
    /// Memory sizes, and the map's range and resolution.
    pub bounds: Bounds,
    /// Hits count twice as evidence if their distances from the sensor along `map`'s x and y are
    /// both at most this, in millimetres. For a grey camera use
    /// [`ScaleCurve::near`](crate::sense::ScaleCurve::near). `None` stands for 0.18 times the
    /// range: the corners of that square are a quarter of the range away, and within it beams are
    /// closer together than cells.
    pub near: Option<NonZero<u16>>,
    /// The sensor's geometry.
    pub sensor: SensorModel,
    /// The sensor in `base_link`.
    pub mounting: Pose,
    /// Which readings are valid.
    pub validity: Validity,
    /// Brightness of the pixels whose depths are valid, for sensors with an intensity image. The
    /// caller applies it to each row ([`Exposure::mask`]) before it passes the row to the robot.
    pub exposure: Exposure,
    /// Readings that are never mapped. The server can set the last two entries, pixels and bearings
    /// ([`Parameter`](crate::Parameter)).
    pub removed: [Option<Removal>; 4],
    /// Maximum turn rate and acceleration for a scan to be mapped.
    pub steady: SteadyLimits,
    /// Where the poses come from: the server's fixes, or odometry alone.
    pub pose_source: PoseSource,
    /// The noise of the odometry.
    pub odometry_noise: OdometryNoise,
    /// Maximum uncertainty of a pose for its scan to be mapped.
    pub uncertainty_limit: UncertaintyLimit,
    /// How far the robot must move before it maps another scan.
    pub gate: Gate,
    /// Which part of a scan is mapped.
    pub policy: Policy,
    /// The shape of the masks that keep other robots out of the map.
    pub peer_mask: PeerMask,
    /// How long a scan waits for its pose.
    pub scan_deadline: Duration,
    /// How long changes of the map are collected before they are sent to the server.
    pub hold: Duration,
    /// Minimum time between two distance vectors while the robot moves. At standstill it sends at
    /// most one per minute; without a recent fix one per second, and more while it turns.
    pub vector_interval: Duration,
    /// The minimum epoch of new tiles.
    pub first_epoch: Epoch,
    /// Whether the board can keep parameters for later boots, so that it asks the robot for them
    /// ([`Machine::poll_store`](crate::Machine::poll_store)).
    pub keeps_parameters: bool,
    /// The drive: [`Driving`](crate::drive::Driving) or [`NoDrive`].
    pub drive: D,
}

/// What a robot needs for a sealed link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Seal {
    /// The key that the robot shares with the server.
    pub key: Key,
    /// The number of this boot. It must be higher than at all earlier boots: read it from memory that
    /// survives a boot, add one, and store it there before the robot is made. With a lower or equal
    /// number the server takes the robot's Hello for a replay, and frames may be sealed with numbers
    /// that must be used only once.
    pub boot: u32,
}

impl Config {
    /// A robot that only maps. A scan waits 1.5 s for its pose, changes are collected for 1 s, and
    /// a distance vector is sent every 5 s.
    pub fn new(robot: RobotId, sensor: SensorModel, bounds: Bounds) -> Self {
        Self {
            robot,
            boot_nonce: 0,
            seal: None,
            bounds,
            near: None,
            sensor,
            mounting: Pose::default(),
            validity: Validity::of(sensor),
            exposure: Exposure::ANY,
            removed: [None; 4],
            steady: SteadyLimits::default(),
            pose_source: PoseSource::Fixes,
            odometry_noise: OdometryNoise::default(),
            uncertainty_limit: UncertaintyLimit::default(),
            gate: Gate::default(),
            policy: Policy::default(),
            peer_mask: PeerMask::default(),
            scan_deadline: SCAN_LATE,
            hold: Duration::from_secs(1),
            vector_interval: Duration::from_secs(5),
            first_epoch: Epoch(0),
            keeps_parameters: false,
            drive: NoDrive,
        }
    }
}

impl<D> Config<D> {
    /// This configuration with another drive.
    pub fn with_drive<E>(self, drive: E) -> Config<E> {
        Config {
            drive,
            robot: self.robot,
            boot_nonce: self.boot_nonce,
            seal: self.seal,
            bounds: self.bounds,
            near: self.near,
            sensor: self.sensor,
            mounting: self.mounting,
            validity: self.validity,
            exposure: self.exposure,
            removed: self.removed,
            steady: self.steady,
            pose_source: self.pose_source,
            odometry_noise: self.odometry_noise,
            uncertainty_limit: self.uncertainty_limit,
            gate: self.gate,
            policy: self.policy,
            peer_mask: self.peer_mask,
            scan_deadline: self.scan_deadline,
            hold: self.hold,
            vector_interval: self.vector_interval,
            first_epoch: self.first_epoch,
            keeps_parameters: self.keeps_parameters,
        }
    }

    /// Checks everything that does not depend on the memory's sizes.
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        let Bounds { resolution, max_range, .. } = self.bounds;
        if resolution < MIN_RESOLUTION {
            return Err(ConfigError::Resolution);
        }
        let radius = i32::from(max_range) / resolution.0.max(1);
        if radius < 1 || radius as usize > MAX_RADIUS {
            return Err(ConfigError::Range);
        }
        Ok(())
    }
}

/// One of the parts of a [`Memory`](crate::Memory).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// The table of beams, one per reading.
    Beams,
    /// The readings of waiting scans.
    Waiting,
    /// The scratch memory, in words.
    Scratch,
    /// The robot's own tiles.
    OwnTiles,
    /// The fused tiles.
    FusedTiles,
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Beams => "beams",
            Self::Waiting => "waiting scans",
            Self::Scratch => "scratch words",
            Self::OwnTiles => "own tiles",
            Self::FusedTiles => "fused tiles",
        })
    }
}

/// Why a robot can't be built from a configuration and a memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConfigError {
    /// The cells are smaller than [`MIN_RESOLUTION`].
    Resolution,
    /// The range is less than one cell, or more than [`MAX_RADIUS`] cells.
    Range,
    /// A part of the memory is empty, or smaller than the configuration's bounds.
    Memory {
        /// The part that is too small.
        part: Part,
        /// Number of elements required.
        needed: usize,
        /// Number of elements present.
        found: usize,
    },
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Resolution => {
                write!(f, "the map's cells must be at least {} mm wide", MIN_RESOLUTION.0)
            }
            Self::Range => {
                write!(f, "the range must be 1 to {MAX_RADIUS} cells of the map")
            }
            Self::Memory { part, needed, found } => {
                write!(f, "the memory for {part} has {found} elements; the bounds require {needed}")
            }
        }
    }
}

impl core::error::Error for ConfigError {}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Memory, Robot, Storage, map::OwnTile, memory};
    use std::{boxed::Box, vec::Vec};
    use ubimap_protocol::units::Millimetres;

    const BOUNDS: Bounds = Bounds::SMALL;

    fn config(bounds: Bounds) -> Config {
        Config::new(RobotId(1), SensorModel::Radial { first: 0.0, step: 0.1 }, bounds)
    }

    fn made<S: Storage>(bounds: Bounds, memory: &mut Memory<S>) -> Result<(), ConfigError> {
        Robot::new(config(bounds), memory).map(|_| ())
    }

    #[test]
    fn an_error_names_the_part_that_is_too_small_with_its_sizes() {
        let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
        let mut made = |bounds| made(bounds, &mut memory);
        assert_eq!(made(BOUNDS), Ok(()));
        let small = |part, needed, found| Err(ConfigError::Memory { part, needed, found });
        assert_eq!(made(Bounds { readings: 65, ..BOUNDS }), small(Part::Beams, 65, 64));
        assert_eq!(made(Bounds { waiting: 3, ..BOUNDS }), small(Part::Waiting, 192, 128));
        assert_eq!(made(Bounds { own_tiles: 9, ..BOUNDS }), small(Part::OwnTiles, 9, 8));
        assert_eq!(made(Bounds { fused_tiles: 16, ..BOUNDS }), small(Part::FusedTiles, 16, 12));
        let far = Bounds { max_range: 4_000, ..BOUNDS };
        assert_eq!(made(far), small(Part::Scratch, far.scratch(), BOUNDS.scratch()));
        // Excess memory is allowed; an empty part is an error.
        assert_eq!(made(Bounds { readings: 9, fused_tiles: 0, own_tiles: 1, ..BOUNDS }), Ok(()));
        assert_eq!(made(Bounds { readings: 0, ..BOUNDS }), small(Part::Beams, 1, 0));
        assert_eq!(made(Bounds { waiting: 0, ..BOUNDS }), small(Part::Waiting, 1, 0));
        assert_eq!(made(Bounds { own_tiles: 0, ..BOUNDS }), small(Part::OwnTiles, 1, 0));
    }

    #[test]
    fn invalid_resolutions_and_ranges_are_refused() {
        let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
        let mut made = |bounds| made(bounds, &mut memory);
        for resolution in [-50, 0, 19] {
            let bounds = Bounds { resolution: Millimetres(resolution), ..BOUNDS };
            assert_eq!(made(bounds), Err(ConfigError::Resolution));
        }
        for (max_range, resolution) in [(49, 50), (0, 50), (20_020, 20)] {
            let bounds = Bounds { max_range, resolution: Millimetres(resolution), ..BOUNDS };
            assert_eq!(made(bounds), Err(ConfigError::Range), "{max_range}");
        }
    }

    /// A storage whose size is set at run time.
    struct Grown;

    impl Storage for Grown {
        type Beams = Vec<crate::sense::Beam>;
        type Waiting = Vec<u16>;
        type Scratch = Vec<crate::map::RowSighting>;
        type Own = Vec<OwnTile>;
        type Fused = Vec<crate::share::FusedTile>;
    }

    #[test]
    fn memory_that_is_sized_at_run_time_fits_its_bounds() {
        for bounds in [Bounds::DEFAULT, Bounds::REFERENCE, Bounds { own_tiles: 77, ..BOUNDS }] {
            assert_eq!(made(bounds, &mut Memory::<Grown>::new(&bounds)), Ok(()));
            let less = Bounds { fused_tiles: bounds.fused_tiles - 1, ..bounds };
            let found = made(bounds, &mut Memory::<Grown>::new(&less));
            let (needed, found_tiles) = (bounds.fused_tiles, less.fused_tiles);
            let part = Part::FusedTiles;
            assert_eq!(found, Err(ConfigError::Memory { part, needed, found: found_tiles }));
        }
    }
}
