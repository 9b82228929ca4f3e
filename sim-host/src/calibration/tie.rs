//! A landmark that two cameras see.

use nalgebra::{
    Isometry3, Matrix3, Matrix6, Point3, SMatrix, Translation3, UnitQuaternion, Vector3, Vector6,
};

use super::{closed_form::rigid_transform, observations::Landmark};

/// A landmark in the frames of cameras i and j: the paper's `p_i^k` and `p_j^k`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Tie {
    /// The landmark's index in each camera.
    pub(super) index: [usize; 2],
    /// Its position in each camera's optical frame, in metres.
    pub(super) point: [Point3<f64>; 2],
    /// The covariance of each position in its optical frame, in square metres.
    pub(super) covariance: [Matrix3<f64>; 2],
}

/// The derivatives of a residual by a rotation and a translation.
pub(super) type Jacobian = SMatrix<f64, 3, 6>;

impl Tie {
    pub(super) fn new(index: [usize; 2], landmarks: [&Landmark; 2]) -> Self {
        Self {
            index,
            point: landmarks.map(|it| it.position),
            covariance: landmarks.map(Landmark::covariance),
        }
    }

    /// `p_i - T_ij p_j`, in metres, in the frame of i.
    pub(super) fn residual(&self, t_ij: &Isometry3<f64>) -> Vector3<f64> {
        self.point[0] - t_ij * self.point[1]
    }

    /// The covariance of the residual: both cameras' noise in the frame of i.
    pub(super) fn residual_covariance(&self, t_ij: &Isometry3<f64>) -> Matrix3<f64> {
        self.covariance[0] + rotated(t_ij, &self.covariance[1])
    }

    /// The squared Mahalanobis distance of the residual; its mean is 3 if only noise is in it.
    pub(super) fn distance2(&self, t_ij: &Isometry3<f64>) -> f64 {
        let residual = self.residual(t_ij);
        let whitened = self.residual_covariance(t_ij).cholesky().map(|it| it.solve(&residual));
        whitened.map_or(f64::INFINITY, |it| residual.dot(&it))
    }

    /// The mean standard deviation of the two positions in one direction, in metres.
    pub(super) fn sigma_m(&self) -> f64 {
        ((self.covariance[0].trace() + self.covariance[1].trace()) / 6.0).sqrt()
    }
}

/// A covariance of camera j's frame in the frame of i.
pub(super) fn rotated(pose: &Isometry3<f64>, covariance: &Matrix3<f64>) -> Matrix3<f64> {
    let turn = pose.rotation.to_rotation_matrix();
    turn.matrix() * covariance * turn.matrix().transpose()
}

/// `T_ij` by the closed form: the pose of j in the frame of i.
pub(super) fn closed_form<'a>(
    ties: impl IntoIterator<Item = &'a Tie, IntoIter: Clone>,
) -> Option<Isometry3<f64>> {
    rigid_transform(ties.into_iter().map(|tie| (&tie.point[1], &tie.point[0])))
}

/// Number of Gauss-Newton steps of [`weighted`]; the closed form is a close start.
const STEPS: usize = 3;

/// `T_ij` by least squares with the inverse covariances as weights, starting from the closed form.
///
/// Distances from the closed form can't tell whether a landmark agrees: the noise of the depths,
/// which it weighs as much as the ten times better directions across, displaces all landmarks by
/// many standard deviations across.
pub(super) fn weighted<'a>(
    ties: impl IntoIterator<Item = &'a Tie, IntoIter: Clone>,
) -> Option<Isometry3<f64>> {
    let ties = ties.into_iter();
    let mut t_ij = closed_form(ties.clone())?;
    for _ in 0..STEPS {
        let (mut gradient, mut hessian) = (Vector6::zeros(), Matrix6::zeros());
        for tie in ties.clone() {
            let weight = tie.residual_covariance(&t_ij).cholesky()?.inverse();
            let jacobian = jacobian(&t_ij, &tie.point[1]);
            let weighted = jacobian.transpose() * weight;
            gradient += weighted * tie.residual(&t_ij);
            hessian += weighted * jacobian;
        }
        let step = hessian.cholesky()?.solve(&gradient);
        t_ij = moved(&t_ij, &step);
    }
    Some(t_ij)
}

/// A pose after a rotation about the axes of its frame and a translation along them.
pub(super) fn moved(pose: &Isometry3<f64>, step: &Vector6<f64>) -> Isometry3<f64> {
    let [turn, shift] = [0, 3].map(|from| Vector3::from(step.fixed_rows::<3>(from)));
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector + shift),
        UnitQuaternion::new(turn) * pose.rotation,
    )
}

/// The derivatives of `T p` by a rotation about the axes of the frame that `T` maps to and by a
/// translation in it.
pub(super) fn jacobian(pose: &Isometry3<f64>, point: &Point3<f64>) -> Jacobian {
    let arm = pose.rotation * point.coords;
    let mut jacobian = Jacobian::zeros();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&-arm.cross_matrix());
    jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&Matrix3::identity());
    jacobian
}

/// The covariance of a closed-form `T_ij`, about and along the axes of i, in radians and metres.
/// The closed form weighs all landmarks equally, whatever their noise. `None` if the landmarks are
/// on a line.
pub(super) fn closed_form_covariance(t_ij: &Isometry3<f64>, ties: &[&Tie]) -> Option<Matrix6<f64>> {
    let (mut normal, mut noise) = (Matrix6::zeros(), Matrix6::zeros());
    for tie in ties {
        let jacobian = jacobian(t_ij, &tie.point[1]);
        normal += jacobian.transpose() * jacobian;
        noise += jacobian.transpose() * tie.residual_covariance(t_ij) * jacobian;
    }
    let inverse = normal.cholesky()?.inverse();
    Some(inverse * noise * inverse)
}
