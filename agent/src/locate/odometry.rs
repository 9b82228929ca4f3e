//! Odometry: how far it is to be trusted, and what it said between two readings.

use ubimap_protocol::units::{Angle, Millimetres, Pose};

use crate::trigonometry::{RADIANS, round};

/// How odometry departs from the truth: standard deviations, whose squares grow with the way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OdometryNoise {
    /// Of x and of y after a metre.
    pub position_per_metre: Millimetres,
    /// Of the heading after a metre.
    pub heading_per_metre: Angle,
    /// Of the heading after turning by a radian.
    pub heading_per_radian: Angle,
}

impl Default for OdometryNoise {
    /// Two driven wheels with encoders: 1.5 cm and 0.5 degrees after a metre, 1 degree after a
    /// radian. Each is half chance, half a slip of 1 %.
    fn default() -> Self {
        Self {
            position_per_metre: Millimetres(15),
            heading_per_metre: Angle(91),
            heading_per_radian: Angle(182),
        }
    }
}

/// How fast variances grow.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct MotionNoise {
    /// Of x and of y along the way: mm^2 for each mm.
    pub(super) position_by_way: f32,
    /// Of the heading along the way: rad^2 for each mm.
    pub(super) heading_by_way: f32,
    /// Of the heading in turns: rad^2 for each rad.
    pub(super) heading_by_turn: f32,
    /// Of x and of y in any case: mm^2 for each second.
    pub(super) position_by_time: f32,
    /// Of the heading in any case: rad^2 for each second.
    pub(super) heading_by_time: f32,
}

impl MotionNoise {
    /// Of odometry, and of what no wheel notices: a push, a carpet. 3 mm and 0.1 degrees after a
    /// second, so that a robot that is pushed a little is believed to be there in 2 s at 15 Hz.
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

/// The pose at a part (0 to 1) of the way, in proportion, turning the short way.
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
    fn the_pose_in_between_is_in_proportion_and_turns_the_short_way() {
        let pose = |x, heading| Pose { x: Millimetres(x), y: Millimetres(-x), heading };
        let (from, to) = (pose(0, Angle(65_000)), pose(1000, Angle(536)));
        assert_eq!(between(from, to, 0.0), from);
        assert_eq!(between(from, to, 0.25), pose(250, Angle(65_268)));
        assert_eq!(between(from, to, 0.75), pose(750, Angle(268)));
        assert_eq!(between(from, to, 1.0), to);
    }
}
