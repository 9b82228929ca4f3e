//! The position and orientation of a camera.

use libm::{atan2, cos, sin};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};
use parry2d_f64::glamx::DVec3;

use super::scenario::CameraConfig;
use crate::camera::{CalibrationError, Intrinsics, Lens};

/// A camera's position in `map` in metres, and its axes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Mounting {
    pub(super) position: DVec3,
    pub(super) forward: DVec3,
    /// The x axis, to the right in the image; level without roll.
    pub(super) right: DVec3,
    pub(super) up: DVec3,
}

impl Mounting {
    pub(super) fn new(config: &CameraConfig) -> Self {
        let position = DVec3::from(config.position_m);
        let (heading, tilt) = match config.look_at_m {
            Some(look_at) => {
                let way = DVec3::from(look_at) - position;
                (atan2(way.y, way.x), atan2(-way.z, way.truncate().length()))
            }
            None => (
                config.heading_deg.unwrap_or_default().to_radians(),
                config.tilt_deg.unwrap_or_default().to_radians(),
            ),
        };
        let level = DVec3::new(cos(heading), sin(heading), 0.0);
        let across = DVec3::new(level.y, -level.x, 0.0);
        let roll = config.roll_deg.unwrap_or_default().to_radians();
        // Without roll nothing is multiplied, so that the same bits come out as ever.
        let (right, above) = if roll == 0.0 {
            (across, DVec3::Z)
        } else {
            let (sin, cos) = (sin(roll), cos(roll));
            (across * cos - DVec3::Z * sin, DVec3::Z * cos + across * sin)
        };
        let forward = level * cos(tilt) - above * sin(tilt);
        Self { position, forward, right, up: right.cross(forward) }
    }

    /// A sensor `left` metres to the left of the camera's position, with the same orientation.
    pub(super) fn lens(&self, left: f64, intrinsics: Intrinsics) -> Result<Lens, CalibrationError> {
        let at = self.position - self.right * left;
        let columns = [self.right, -self.up, self.forward].map(|axis| axis.to_array().into());
        let turn = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&columns));
        let pose = Isometry3::from_parts(
            Translation3::new(at.x, at.y, at.z),
            UnitQuaternion::from_rotation_matrix(&turn),
        );
        Lens::new(intrinsics, pose)
    }
}
