//! A small motion of a camera, and how well it is known.

use nalgebra::{Isometry3, Matrix3, Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};

/// Standard deviations of a motion before anything is measured, in metres and radians: where nothing in
/// view tells a direction, the camera counts as standing still in it.
const PRIOR_M: f64 = 0.1;
const PRIOR_RAD: f64 = 0.1;

/// An estimate of a motion, in the optical frame of the camera: translation in metres, then rotation in
/// radians.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// The information matrix, the inverse of the covariance, without the prior.
    information: Matrix6<f64>,
    /// The information matrix times the motion.
    weighted: Vector6<f64>,
}

impl Motion {
    /// Nothing is known.
    pub const UNKNOWN: Self = Self {
        information: Matrix6::from_array_storage(nalgebra::ArrayStorage([[0.0; 6]; 6])),
        weighted: Vector6::from_array_storage(nalgebra::ArrayStorage([[0.0; 6]])),
    };

    /// The motion with this value and information.
    pub(super) fn new(value: &Vector6<f64>, information: Matrix6<f64>) -> Self {
        Self { information, weighted: information * value }
    }

    /// The motion with this information, and this product of both.
    pub(super) fn weighted(weighted: Vector6<f64>, information: Matrix6<f64>) -> Self {
        Self { information, weighted }
    }

    /// Both estimates of one motion together.
    #[must_use]
    pub fn with(&self, other: &Self) -> Self {
        Self {
            information: self.information + other.information,
            weighted: self.weighted + other.weighted,
        }
    }

    /// The same estimate with a part of its information.
    #[must_use]
    pub fn faded(&self, part: f64) -> Self {
        Self { information: self.information * part, weighted: self.weighted * part }
    }

    /// The motion and its covariance, in which unknown directions have the prior's.
    pub fn estimate(&self) -> Option<(Vector6<f64>, Matrix6<f64>)> {
        let covariance = (self.information + prior()).try_inverse()?;
        Some((covariance * self.weighted, covariance))
    }

    /// The squared Mahalanobis distance of a motion from none, by this information.
    pub(super) fn distance(&self, value: &Vector6<f64>) -> f64 {
        value.dot(&(self.information * value))
    }

    /// The maximum standard deviation in any direction of a shift, in metres, and of a turn, in radians.
    pub fn doubt(&self) -> Option<[f64; 2]> {
        let (_, covariance) = self.estimate()?;
        Some([0, 3].map(|first| {
            let block: Matrix3<f64> = covariance.fixed_view::<3, 3>(first, first).into();
            libm::sqrt(block.symmetric_eigenvalues().max())
        }))
    }
}

/// The information of the prior.
pub(super) fn prior() -> Matrix6<f64> {
    let [metres, radians] = [PRIOR_M, PRIOR_RAD].map(|it| 1.0 / (it * it));
    Matrix6::from_diagonal(&Vector6::new(metres, metres, metres, radians, radians, radians))
}

/// The transform of a small motion.
pub(super) fn transform(motion: &Vector6<f64>) -> Isometry3<f64> {
    let shift: Vector3<f64> = motion.fixed_rows::<3>(0).into();
    let turn: Vector3<f64> = motion.fixed_rows::<3>(3).into();
    Isometry3::from_parts(Translation3::from(shift), UnitQuaternion::from_scaled_axis(turn))
}

/// The motion of a small transform.
pub(super) fn motion(transform: &Isometry3<f64>) -> Vector6<f64> {
    let (shift, turn) = (transform.translation.vector, transform.rotation.scaled_axis());
    Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z)
}

/// The lengths of a motion's shift, in metres, and turn, in radians.
pub(super) fn lengths(motion: &Vector6<f64>) -> [f64; 2] {
    [motion.fixed_rows::<3>(0).norm(), motion.fixed_rows::<3>(3).norm()]
}
