//! What of a robot's configuration counts while it runs.

use core::num::NonZero;

use ubimap_protocol::{
    tile::Epoch,
    time::Duration,
    units::{Millimetres, Pose, RobotId},
};

use super::config::Config;
use crate::{
    map::{Gate, MappingConfig, PeerMask, Policy},
    sense::{Exposure, Removal, SensorModel, Validity},
};

/// What of a robot's [`Config`] counts while it runs, as the server has changed it. The fields mean
/// what they mean there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The robot's number.
    pub robot: RobotId,
    /// The side of the map's cells.
    pub resolution: Millimetres,
    /// The radial range that is mapped, in millimetres.
    pub max_range: u16,
    /// Hits this near count twice, in millimetres.
    pub near: Option<NonZero<u16>>,
    /// What the sensor's readings mean.
    pub sensor: SensorModel,
    /// The sensor in `base_link`.
    pub mounting: Pose,
    /// Which readings count.
    pub validity: Validity,
    /// The light of pixels whose depths count: the caller masks rows by it ([`Exposure::mask`]).
    pub exposure: Exposure,
    /// Readings that are never mapped.
    pub removed: [Option<Removal>; 4],
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
    /// Tiles are begun from this epoch on, or a later one.
    pub first_epoch: Epoch,
}

impl<D> From<&Config<D>> for Settings {
    fn from(config: &Config<D>) -> Self {
        Self {
            robot: config.robot,
            resolution: config.bounds.resolution,
            max_range: config.bounds.max_range,
            near: config.near,
            sensor: config.sensor,
            mounting: config.mounting,
            validity: config.validity,
            exposure: config.exposure,
            removed: config.removed,
            gate: config.gate,
            policy: config.policy,
            peer_mask: config.peer_mask,
            scan_deadline: config.scan_deadline,
            hold: config.hold,
            first_epoch: config.first_epoch,
        }
    }
}

impl From<&Settings> for MappingConfig {
    fn from(settings: &Settings) -> Self {
        let &Settings { resolution, max_range, near, mounting, validity, policy, .. } = settings;
        let near = near.map_or((u32::from(max_range) * 45 / 256) as u16, NonZero::get);
        Self { resolution, max_range, near, mounting, validity, policy }
    }
}
