//! Rigid motions of the plane, in metres and radians.

use nalgebra::{Isometry2, Matrix3, UnitComplex, Vector2, Vector3};
use ubimap_protocol::units::Pose;

/// The motion that takes a frame to another: a translation in metres and a turn in radians.
pub type Motion = Isometry2<f64>;

/// The motion of a pose on the wire.
pub fn motion(pose: Pose) -> Motion {
    Motion::new(Vector2::new(pose.x.metres(), pose.y.metres()), pose.heading.radians())
}

/// The pose of a motion, in millimetres and binary angles.
pub fn pose(motion: &Motion) -> Pose {
    Pose::from_metres(motion.translation.x, motion.translation.y, motion.rotation.angle())
}

/// Whether a motion is at most this far, in metres, and turns by at most this much, in radians.
pub fn is_within(motion: &Motion, (way, turn): (f64, f64)) -> bool {
    motion.translation.vector.norm() <= way && motion.rotation.angle().abs() <= turn
}

/// The position and turn of a motion.
pub(super) fn coordinates(motion: &Motion) -> Vector3<f64> {
    Vector3::new(motion.translation.x, motion.translation.y, motion.rotation.angle())
}

/// The motion with this position and turn.
pub(super) fn of_coordinates(vector: Vector3<f64>) -> Motion {
    Motion::new(vector.xy(), vector.z)
}

/// By how much `to` differs from `from`: x, y and turn, in the frame of both.
pub fn difference(from: &Motion, to: &Motion) -> Vector3<f64> {
    let off = to.translation.vector - from.translation.vector;
    Vector3::new(off.x, off.y, (to.rotation / from.rotation).angle())
}

/// The motion that brings poses nearest to others: their positions, and their headings as at an arm of 1 m.
pub(super) fn fit(poses: &[Motion], others: &[Motion]) -> Motion {
    let mean = |poses: &[Motion]| {
        poses.iter().map(|it| it.translation.vector).sum::<Vector2<f64>>()
            / poses.len().max(1) as f64
    };
    let (middle, goal) = (mean(poses), mean(others));
    let sum = poses.iter().zip(others).fold(Vector2::zeros(), |sum, (pose, other)| {
        let (one, other_at) = (pose.translation.vector - middle, other.translation.vector - goal);
        let turn = other.rotation / pose.rotation;
        sum + Vector2::new(one.dot(&other_at) + turn.re, one.perp(&other_at) + turn.im)
    });
    let turn = UnitComplex::new(libm::atan2(sum.y, sum.x));
    Motion::from_parts((goal - turn * middle).into(), turn)
}

/// A measured motion.
#[derive(Clone, Debug)]
pub struct Measured {
    /// The motion.
    pub motion: Motion,
    /// Covariance of x, y and turn, in the frame from which the motion starts.
    pub covariance: Matrix3<f64>,
}

impl Measured {
    /// No motion, exactly.
    pub(super) fn none() -> Self {
        Self { motion: Motion::identity(), covariance: Matrix3::zeros() }
    }

    /// This motion and then another, which is independent of it.
    pub fn then(&self, next: &Self) -> Self {
        let arm = self.motion.rotation * next.motion.translation.vector;
        let by_own = Matrix3::new(1.0, 0.0, -arm.y, 0.0, 1.0, arm.x, 0.0, 0.0, 1.0);
        let by_next = turned(self.motion.rotation.angle());
        Self {
            motion: self.motion * next.motion,
            covariance: by_own * self.covariance * by_own.transpose()
                + by_next * next.covariance * by_next.transpose(),
        }
    }

    /// The motion back.
    pub fn inverse(&self) -> Self {
        let motion = self.motion.inverse();
        let arm = motion.translation.vector;
        let by_own = Matrix3::new(1.0, 0.0, -arm.y, 0.0, 1.0, arm.x, 0.0, 0.0, 1.0)
            * turned(motion.rotation.angle());
        Self { motion, covariance: by_own * self.covariance * by_own.transpose() }
    }

    /// The inverse of the covariance; zero if it has none.
    pub(super) fn information(&self) -> Matrix3<f64> {
        self.covariance.try_inverse().unwrap_or_else(Matrix3::zeros)
    }
}

/// The matrix that turns x and y by an angle and keeps the heading.
pub fn turned(angle: f64) -> Matrix3<f64> {
    let (sin, cos) = (libm::sin(angle), libm::cos(angle));
    Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The covariance of a function of two motions, from differences of its value.
    fn numerical(
        [first, second]: [&Measured; 2],
        of: impl Fn(&Motion, &Motion) -> Motion,
    ) -> Matrix3<f64> {
        let middle = of(&first.motion, &second.motion);
        let moved = |motion: &Motion, axis: usize| {
            let mut at = coordinates(motion);
            at[axis] += 1e-6;
            of_coordinates(at)
        };
        let mut sum = Matrix3::zeros();
        for (which, its) in [first, second].into_iter().enumerate() {
            let mut by = Matrix3::zeros();
            for axis in 0..3 {
                let value = match which {
                    0 => of(&moved(&first.motion, axis), &second.motion),
                    _ => of(&first.motion, &moved(&second.motion, axis)),
                };
                by.set_column(axis, &(difference(&middle, &value) / 1e-6));
            }
            sum += by * its.covariance * by.transpose();
        }
        sum
    }

    fn measured() -> impl Strategy<Value = Measured> {
        let number = || -3.0..3.0f64;
        let spread = || 0.1..1.0f64;
        ((number(), number(), number()), (spread(), spread(), spread(), -0.05..0.05)).prop_map(
            |((x, y, turn), (a, b, c, mixed))| {
                let mut covariance = Matrix3::from_diagonal(&Vector3::new(a, b, c));
                for (row, column) in [(0, 1), (1, 0), (0, 2), (2, 0)] {
                    covariance[(row, column)] = mixed;
                }
                Measured { motion: of_coordinates(Vector3::new(x, y, turn)), covariance }
            },
        )
    }

    proptest! {
        #[test]
        fn a_motion_is_found_again(
            motion in measured(),
            poses in proptest::collection::vec(measured(), 1..5),
        ) {
            let poses: Vec<Motion> = poses.into_iter().map(|it| it.motion).collect();
            let others: Vec<Motion> = poses.iter().map(|it| motion.motion * it).collect();
            prop_assert!(difference(&fit(&poses, &others), &motion.motion).amax() < 1e-9);
        }

        #[test]
        fn covariances_are_those_of_differences(first in measured(), second in measured()) {
            let both = first.then(&second);
            let expected = numerical([&first, &second], |a, b| a * b);
            prop_assert!((both.covariance - expected).amax() < 1e-3, "{}", both.covariance - expected);
            let back = first.inverse();
            let expected = numerical([&first, &Measured::none()], |a, _| a.inverse());
            prop_assert!((back.covariance - expected).amax() < 1e-3, "{}", back.covariance - expected);
        }
    }
}
