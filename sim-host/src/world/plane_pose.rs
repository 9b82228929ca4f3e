//! A pose in the plane.

use std::f64::consts::{PI, TAU};

use parry2d_f64::glamx::DVec2;
use ubimap_protocol::units::Pose;

/// A position in metres and a heading in radians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PlanePose {
    pub(super) position: DVec2,
    pub(super) heading: f64,
}

impl PlanePose {
    /// Rounded to the units of the protocol.
    pub(super) fn quantised(self) -> Pose {
        Pose::from_metres(self.position.x, self.position.y, self.heading)
    }
}

/// Wraps an angle to -pi..pi.
pub(super) fn wrap(angle: f64) -> f64 {
    let wrapped = libm::fmod(angle, TAU);
    match wrapped {
        _ if wrapped > PI => wrapped - TAU,
        _ if wrapped < -PI => wrapped + TAU,
        _ => wrapped,
    }
}
