//! The orientation of a fixed camera by three angles.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

/// The orientation of a camera's optical frame (x right, y down, z forward) in `map`.
///
/// The heading turns the camera about the vertical axis; the roll then turns it about the horizontal
/// axis in the direction of the heading; the tilt then turns it about the x axis of the image. In this
/// order a camera that looks nearly straight down has a small roll and a heading that is the
/// direction of the top of its image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Orientation {
    /// Direction in which it faces, counter-clockwise from x, in radians.
    pub heading_rad: f64,
    /// Downward tilt, in radians: 0 is level, a right angle straight down.
    pub tilt_rad: f64,
    /// Angle by which the right side of the image is below the horizontal, in radians.
    pub roll_rad: f64,
}

impl Orientation {
    /// The rotation from the optical frame to `map`.
    pub fn rotation(&self) -> UnitQuaternion<f64> {
        let [(sin, cos), (sin_tilt, cos_tilt), (sin_roll, cos_roll)] =
            [self.heading_rad, self.tilt_rad, self.roll_rad]
                .map(|it| (libm::sin(it), libm::cos(it)));
        let ahead = Vector3::new(cos, sin, 0.0);
        let level = Vector3::new(sin, -cos, 0.0);
        let right = level * cos_roll - Vector3::z() * sin_roll;
        let up = Vector3::z() * cos_roll + level * sin_roll;
        let forward = ahead * cos_tilt - up * sin_tilt;
        let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes))
    }

    /// The angles of a rotation from the optical frame to `map`. The roll is between -90 and 90
    /// degrees; if the x axis of the image is vertical, heading and tilt turn about the same axis, and
    /// the heading is zero.
    pub fn of(rotation: &UnitQuaternion<f64>) -> Self {
        let [right, _, forward] =
            [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| rotation * axis);
        let across = libm::hypot(right.x, right.y);
        let roll_rad = libm::atan2(-right.z, across);
        let heading_rad = if across > 1e-12 { libm::atan2(right.x, -right.y) } else { 0.0 };
        let ahead = Vector3::new(libm::cos(heading_rad), libm::sin(heading_rad), 0.0);
        let up = right.cross(&ahead);
        let tilt_rad = libm::atan2(-forward.dot(&up), forward.dot(&ahead));
        Self { heading_rad, tilt_rad, roll_rad }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_angles_of_a_rotation_give_the_rotation(
            turn in prop::array::uniform3(-3.2f64..3.2), downward: bool,
        ) {
            // Also rotations next to straight down.
            let turn = if downward {
                let down = Orientation { tilt_rad: 1.57, heading_rad: turn[0], roll_rad: 1e-9 * turn[1] };
                down.rotation()
            } else {
                UnitQuaternion::new(Vector3::from(turn))
            };
            let angles = Orientation::of(&turn);
            prop_assert!(angles.rotation().angle_to(&turn) < 1e-7);
            let matrix = angles.rotation().to_rotation_matrix();
            prop_assert!((matrix.matrix() - turn.to_rotation_matrix().matrix()).norm() < 1e-13);
        }

        #[test]
        fn the_rotation_of_angles_gives_the_angles(
            heading_rad in -3.1f64..3.1, tilt_rad in -3.1f64..3.1, roll_rad in -1.5f64..1.5,
        ) {
            let angles = Orientation { heading_rad, tilt_rad, roll_rad };
            let again = Orientation::of(&angles.rotation());
            prop_assert!((again.heading_rad - heading_rad).abs() < 1e-12);
            prop_assert!((again.tilt_rad - tilt_rad).abs() < 1e-12);
            prop_assert!((again.roll_rad - roll_rad).abs() < 1e-12);
        }
    }

    #[test]
    fn a_vertical_x_axis_has_angles_too() {
        for sign in [1.0, -1.0] {
            let turn = Orientation {
                heading_rad: 0.3,
                tilt_rad: 0.4,
                roll_rad: sign * std::f64::consts::FRAC_PI_2,
            };
            let again = Orientation::of(&turn.rotation());
            assert!(again.rotation().angle_to(&turn.rotation()) < 1e-7);
        }
    }

    #[test]
    fn roll_lowers_the_right_side_of_the_image() {
        let orientation = Orientation { roll_rad: 0.1, ..Orientation::default() };
        let right = orientation.rotation() * Vector3::x();
        assert!((right - Vector3::new(0.0, -libm::cos(0.1), -libm::sin(0.1))).norm() < 1e-12);
    }
}
