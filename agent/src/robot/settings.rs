//! The settings of a robot, which can change at run time.

use core::num::NonZero;

use ubimap_protocol::{
    tile::Epoch,
    time::Duration,
    units::{Millimetres, Pose, RobotId},
};

use super::{config::Config, parameter_storage::ParameterStorage};
use crate::{
    map::{Gate, MappingConfig, PeerMask, Policy},
    sense::{Exposure, Removal, SensorModel, Validity},
};

/// The part of a robot's [`Config`] that applies at run time, with the changes that the server has
/// made. The fields mean the same as in [`Config`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settings {
    /// The robot's id.
    pub robot: RobotId,
    /// The side of a map cell.
    pub resolution: Millimetres,
    /// The maximum mapped range, in millimetres.
    pub max_range: u16,
    /// Hits count twice as evidence if their distances from the sensor along `map`'s x and y are
    /// both at most this, in millimetres.
    pub near: Option<NonZero<u16>>,
    /// The sensor's geometry.
    pub sensor: SensorModel,
    /// The sensor in `base_link`.
    pub mounting: Pose,
    /// Which readings are valid.
    pub validity: Validity,
    /// Brightness of the pixels whose depths are valid. The caller applies it to each row
    /// ([`Exposure::mask`]).
    pub exposure: Exposure,
    /// Readings that are never mapped.
    pub removed: [Option<Removal>; 4],
    /// How far the robot must move before it maps another scan.
    pub gate: Gate,
    /// Which part of a scan is mapped.
    pub policy: Policy,
    /// The shape of the masks that keep other robots out of the map.
    pub peer_mask: PeerMask,
    /// How long a scan waits for its pose.
    pub scan_deadline: Duration,
    /// How long changes of the map are collected before they are sent.
    pub hold: Duration,
    /// The minimum epoch of new tiles.
    pub first_epoch: Epoch,
    /// Whether the board has stored them.
    pub(super) parameter_storage: ParameterStorage,
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
            parameter_storage: ParameterStorage::default(),
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
