//! Odometry: its noise, and interpolation between two readings.

use ubimap_protocol::units::{Angle, Millimetres, Pose};

use crate::trigonometry::{RADIANS, round};

/// The noise of odometry, as standard deviations; their squares (the variances) grow with the
/// distance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OdometryNoise {
    /// Deviation of x and of y after one metre.
    pub position_per_metre: Millimetres,
    /// Deviation of the heading after one metre.
    pub heading_per_metre: Angle,
    /// Deviation of the heading after a turn of one radian.
    pub heading_per_radian: Angle,
}

impl Default for OdometryNoise {
    /// Two driven wheels with encoders: 1.5 cm and 0.5 degrees after one metre, 1 degree after one
    /// radian. Half of each is random; the other half is a slip of 1 %.
    fn default() -> Self {
        Self {
            position_per_metre: Millimetres(15),
            heading_per_metre: Angle(91),
            heading_per_radian: Angle(182),
        }
    }
}

/// Growth of the variances by the motion and by time.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct MotionNoise {
    /// Variance of x and of y per distance, in mm^2/mm.
    pub(super) position_by_way: f32,
    /// Variance of the heading per distance, in rad^2/mm.
    pub(super) heading_by_way: f32,
    /// Variance of the heading per angle turned, in rad^2/rad.
    pub(super) heading_by_turn: f32,
    /// Variance of x and of y per time, in mm^2/s.
    pub(super) position_by_time: f32,
    /// Variance of the heading per time, in rad^2/s.
    pub(super) heading_by_time: f32,
}

impl MotionNoise {
    /// The given noise, plus motion that the wheels do not notice, such as a push: 3 mm and 0.1
    /// degrees after one second, so that a small push is accepted within 2 s at 15 Hz.
    pub(super) fn of(noise: &OdometryNoise) -> Self {
        let square = |value: f32| value * value;
        let radians = |angle: Angle| f32::from(angle.0) * RADIANS;
        Self {
            position_by_way: square(noise.position_per_metre.0 as f32) / 1_000.0,
            heading_by_way: square(radians(noise.heading_per_metre)) / 1_000.0,
            heading_by_turn: square(radians(noise.heading_per_radian)),
            position_by_time: 9.0,
            heading_by_time: 3.0e-6,
        }
    }
}

/// Interpolates between two poses, turning the short way. `part` is 0 at `from` and 1 at `to`;
/// above 1 it extrapolates.
pub(super) fn between(from: Pose, to: Pose, part: f32) -> Pose {
    let mix = |from: Millimetres, to: Millimetres| {
        from + Millimetres(round((to - from).0 as f32 * part) as i32)
    };
    let turn = f32::from((to.heading - from.heading).0 as i16) * part;
    Pose {
        x: mix(from.x, to.x),
        y: mix(from.y, to.y),
        heading: from.heading + Angle(round(turn) as i32 as u16),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_are_interpolated_the_short_way_round() {
        let pose = |x, heading| Pose { x: Millimetres(x), y: Millimetres(-x), heading };
        let (from, to) = (pose(0, Angle(65_000)), pose(1000, Angle(536)));
        assert_eq!(between(from, to, 0.0), from);
        assert_eq!(between(from, to, 0.25), pose(250, Angle(65_268)));
        assert_eq!(between(from, to, 0.75), pose(750, Angle(268)));
        assert_eq!(between(from, to, 1.0), to);
    }
}
