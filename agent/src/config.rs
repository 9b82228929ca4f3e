//! What an agent is made from: its configuration and the caller's memory.

use core::num::NonZero;

use ubimap_protocol::{
    tile::Epoch,
    time::Duration,
    units::{Millimetres, Pose, RobotId},
};

use crate::{
    locate::{OdometryNoise, PoseSource, UncertaintyLimit},
    map::{Gate, MappingConfig, OwnTile, PeerMask, Policy, RowSighting},
    sense::{Beam, Exposure, Removal, SensorModel, SteadyLimits, Validity},
    share::FusedTile,
    timing::SCAN_LATE,
};

/// What does not change while the robot runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Config {
    /// Which robot.
    pub robot: RobotId,
    /// Should differ from boot to boot.
    pub boot_nonce: u32,
    /// The side of the map's cells; the server's must be the same.
    pub resolution: Millimetres,
    /// Beyond it nothing is mapped: millimetres, radial.
    pub max_range: u16,
    /// Hits this near along x and along y of the map count twice, in millimetres: for a grey camera
    /// what [`ScaleCurve::near`](crate::sense::ScaleCurve::near) says. `None` is the square within a
    /// quarter of the range, where beams are closer than cells.
    pub near: Option<NonZero<u16>>,
    /// What the sensor's readings mean.
    pub sensor: SensorModel,
    /// The sensor in `base_link`.
    pub mounting: Pose,
    /// Which readings count.
    pub validity: Validity,
    /// The light of pixels whose depths count, for who has an intensity image beside its depths:
    /// by it the caller masks a row before the agent gets it ([`Exposure::mask`]).
    pub exposure: Exposure,
    /// Readings that are never mapped. The last two are the server's to set
    /// ([`Parameter`](crate::Parameter)): pixels, and bearings.
    pub removed: [Option<Removal>; 4],
    /// How fast the robot may turn and gain speed for a scan to be mapped.
    pub steady: SteadyLimits,
    /// Where the poses come from.
    pub pose_source: PoseSource,
    /// How far the odometry is to be trusted.
    pub odometry_noise: OdometryNoise,
    /// Scans from poses that are less sure than this are not mapped.
    pub uncertainty_limit: UncertaintyLimit,
    /// How far the robot must have moved to map again.
    pub gate: Gate,
    /// How much of what the sensor says is mapped.
    pub policy: Policy,
    /// What is not mapped of other robots.
    pub peer_mask: PeerMask,
    /// How long a scan waits for its pose.
    pub scan_deadline: Duration,
    /// How long changes of the map are gathered before they are sent.
    pub hold: Duration,
    /// Between two distance vectors at least, while the robot moves; one that stands still sends
    /// one in a minute at most, and one that has had no fix for a while one in a second.
    pub vector_interval: Duration,
    /// Tiles are begun from this epoch on, or a later one.
    pub first_epoch: Epoch,
}

impl Config {
    /// The usual robot: 5 cm cells, 4 m of range, a scan waits 1.5 s, changes wait 1 s,
    /// a distance vector every 5 s.
    pub fn new(robot: RobotId, sensor: SensorModel) -> Self {
        Self {
            robot,
            boot_nonce: 0,
            resolution: Millimetres(50),
            max_range: 4_000,
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
        }
    }
}

impl From<&Config> for MappingConfig {
    fn from(config: &Config) -> Self {
        let &Config { resolution, max_range, near, mounting, validity, policy, .. } = config;
        let near = near.map_or((u32::from(max_range) * 45 / 256) as u16, NonZero::get);
        Self { resolution, max_range, near, mounting, validity, policy }
    }
}

/// The caller's memory, which bounds everything that the agent keeps.
#[derive(Debug)]
pub struct Memory<'b> {
    /// One for each reading of a scan.
    pub beams: &'b mut [Beam],
    /// As many readings as scans shall be able to wait, at most 8.
    pub waiting: &'b mut [u16],
    /// At least [`scratch_words`](crate::map::scratch_words).
    pub scratch: &'b mut [RowSighting],
    /// The pool of the robot's own tiles; a scan of 4 m touches 21 of 5 cm at most.
    pub own: &'b mut [OwnTile],
    /// The pool of fused tiles.
    pub fused: &'b mut [FusedTile],
}

/// Why an agent cannot be made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConfigError {
    /// The cells are smaller than 8 mm.
    Resolution,
    /// The range is over 1,000 cells, or nothing.
    Range,
    /// The scratch memory is too short; it must have this many words.
    Scratch(usize),
    /// There is no memory for a scan, or none for a tile.
    Memory,
}
