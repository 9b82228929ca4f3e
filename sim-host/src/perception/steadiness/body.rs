//! The robots in a camera's view, which are no part of the room.

use nalgebra::Vector3;
use ubimap_protocol::units::Pose;

use crate::perception::Footprint;

/// Margin around a robot, for the error of its pose and its way between two images, in metres.
const MARGIN_M: f64 = 0.1;
/// Number of places on a ray that are compared with a robot; those of a robot 0.3 m high, seen at 45 degrees,
/// are 0.1 m apart.
const PLACES: u32 = 4;

/// A robot as an upright box.
#[derive(Clone, Copy, Debug)]
pub struct Body {
    /// What it covers of the floor.
    pub footprint: Footprint,
    /// `base_link` in `map`.
    pub pose: Pose,
    /// Its height above the floor, in metres.
    pub height_m: f64,
}

impl Body {
    /// Whether the robot hides the floor at the end of a ray that leads down `from` a camera, in `map`, metres.
    pub(super) fn is_before(&self, from: &Vector3<f64>, along: &Vector3<f64>) -> bool {
        if along.z >= 0.0 {
            return false;
        }
        let (sin, cos) = libm::sincos(self.pose.heading.radians());
        let Footprint { half_length, half_width, .. } = self.footprint;
        let half = [half_length, half_width].map(|it| f64::from(it) / 1000.0 + MARGIN_M);
        let (x, y) = (self.pose.x.metres(), self.pose.y.metres());
        (0..=PLACES).any(|step| {
            let height = (self.height_m + MARGIN_M) * f64::from(step) / f64::from(PLACES);
            let at = from + along * ((height - from.z) / along.z);
            let (dx, dy) = (at.x - x, at.y - y);
            (dx * cos + dy * sin).abs() <= half[0] && (dy * cos - dx * sin).abs() <= half[1]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_hides_the_floor_under_and_behind_it() {
        let footprint = Footprint { half_length: 200, half_width: 100, is_round: false };
        let quarter = core::f64::consts::FRAC_PI_2;
        let robot = Body { footprint, pose: Pose::from_metres(2.0, 1.0, quarter), height_m: 0.3 };
        let from = Vector3::new(0.0, 1.0, 2.5);
        // It stands across: 0.1 m to both sides of 2 m along x, and its shadow is longer by its height.
        let end = 2.2 / (1.0 - 0.4 / 2.5);
        for (x, y, expected) in [
            (1.75, 1.0, false),
            (1.85, 1.0, true),
            (2.0, 1.25, true),
            (2.0, 1.45, false),
            (end - 0.05, 1.0, true),
            (end + 0.05, 1.0, false),
        ] {
            let along = Vector3::new(x, y, 0.0) - from;
            assert_eq!(robot.is_before(&from, &along), expected, "{x} {y}");
        }
        assert!(!robot.is_before(&from, &Vector3::new(1.0, 0.0, 0.1)), "a wall above it");
    }
}
