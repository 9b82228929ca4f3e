//! Global optimisation: all camera poses together minimise the paper's cost
//!
//! ```text
//! C = sum over (i, j), k of |T_ij p_i^k - p_j^k|^2
//! ```
//!
//! by Levenberg-Marquardt. The paper's two formulas take `T_ij` in opposite directions; here it is
//! the pose of j in i, as in `T_0k = T_0i T_ij T_jk`, and the residual is `T_0i p_i - T_0j p_j` in
//! `R0`, which has the same length.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix3, Matrix6, MatrixXx3, Vector3, Vector6};

use super::{
    levenberg_marquardt::{LeastSquares, minimise},
    observations::Floor,
    tie::{self, Jacobian, Tie, jacobian, rotated},
};
use crate::perception::FloorPlane;

/// How residuals are weighted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Weighting {
    /// By the inverse covariance of both cameras' noise, and robust (Huber).
    #[default]
    Covariance,
    /// All landmarks equally: the paper's `C`.
    Unweighted,
}

/// The landmarks that two cameras share.
#[derive(Clone, Debug)]
pub(super) struct Link {
    pub(super) cameras: [usize; 2],
    pub(super) ties: Vec<Tie>,
    /// For each tie, by how much the pairs of cameras outnumber the information: of n cameras that
    /// see a landmark, n (n - 1) / 2 pairs share n - 1 independent residuals.
    pub(super) shares: Vec<f64>,
}

/// What is minimised.
#[derive(Clone, Debug)]
pub(super) struct Problem<'a> {
    pub(super) links: &'a [Link],
    /// The floor seen by each camera; its height in `R0` is zero.
    pub(super) floors: Vec<Option<Floor>>,
    /// For each camera, which of its rotations and translations about and along the axes of `R0`
    /// are estimated.
    pub(super) free: Vec<[bool; 6]>,
    pub(super) weighting: Weighting,
}

/// The minimum.
#[derive(Clone, Debug)]
pub(super) struct Refined {
    pub(super) poses: Vec<Isometry3<f64>>,
    /// The covariance of each pose about and along the axes of `R0`, in radians and metres; zero
    /// where nothing is estimated.
    pub(super) covariances: Vec<Matrix6<f64>>,
    /// The ratio of the residuals to their stated noise; one if that is right.
    pub(super) noise_ratio: f64,
}

/// Residuals beyond this many standard deviations count linearly (Huber).
const HUBER_SIGMAS: f64 = 2.5;
/// Maximum number of times that the weights are computed.
const ROUNDS: usize = 30;
/// The weights are final when no pose moves by more (radians, metres).
const SETTLED: f64 = 1e-12;
/// Minimum number of redundant residuals from which the noise is estimated.
const REDUNDANT: usize = 10;

impl Problem<'_> {
    /// Minimises from these poses. `None` if the landmarks and floors do not determine all free
    /// parameters.
    pub(super) fn refine(&self, start: &[Isometry3<f64>]) -> Option<Refined> {
        let mut poses = start.to_vec();
        for _ in 0..ROUNDS {
            let next = minimise(&self.weighted(&poses), &poses);
            let change = poses.iter().zip(&next).map(|(a, b)| distance(a, b)).fold(0.0, f64::max);
            poses = next;
            if change < SETTLED {
                break;
            }
        }
        let weighted = self.weighted(&poses);
        let (_, hessian) = weighted.normal_equations(&poses);
        let inverse = hessian.cholesky()?.inverse();
        // With other weights than the inverse covariance, the noise passes through the estimate.
        let covariance = &inverse * weighted.noise(&poses) * &inverse;
        let noise_ratio = self.noise_ratio(&poses, covariance.nrows());
        // The residuals tell little of errors that are common to many landmarks.
        let common = &inverse * weighted.common_noise(&poses) * &inverse;
        let scaled = covariance * (noise_ratio * noise_ratio) + common;
        let columns = self.columns();
        let of_camera = |columns: &[Option<usize>; 6]| {
            Matrix6::from_fn(|row, column| match (columns[row], columns[column]) {
                (Some(row), Some(column)) => scaled[(row, column)],
                _ => 0.0,
            })
        };
        let covariances = columns.iter().map(of_camera).collect();
        Some(Refined { poses, covariances, noise_ratio })
    }

    /// The square root of the mean squared residual, in standard deviations, per redundant residual.
    fn noise_ratio(&self, poses: &[Isometry3<f64>], parameters: usize) -> f64 {
        let (mut sum, mut count) = (0.0, 0.0);
        for (link, tie, share) in self.ties() {
            let t_ij = poses[link.cameras[0]].inv_mul(&poses[link.cameras[1]]);
            sum += share * tie.distance2(&t_ij).min(HUBER_SIGMAS * HUBER_SIGMAS * 3.0);
            count += 3.0 * share;
        }
        for ((floor, free), pose) in self.floors.iter().zip(&self.free).zip(poses) {
            if let Some(floor) = floor.filter(|_| free.contains(&true)) {
                sum += floor_residual(&floor, pose).norm_squared();
                count += 3.0;
            }
        }
        let redundant = count - parameters as f64;
        if redundant < REDUNDANT as f64 { 1.0 } else { (sum / redundant).sqrt() }
    }

    fn ties(&self) -> impl Iterator<Item = (&Link, &Tie, f64)> {
        self.links.iter().flat_map(|link| {
            link.ties.iter().zip(&link.shares).map(move |(tie, &share)| (link, tie, share))
        })
    }

    /// The parameters' index of each rotation and translation of each camera.
    fn columns(&self) -> Vec<[Option<usize>; 6]> {
        let mut next = 0;
        let mut number = |is_free: bool| {
            is_free.then(|| {
                next += 1;
                next - 1
            })
        };
        self.free.iter().map(|free| free.map(&mut number)).collect()
    }

    /// The problem with the weights of these poses.
    fn weighted(&self, poses: &[Isometry3<f64>]) -> Weighted<'_> {
        let common = self.common_variance();
        let terms = self.ties().map(|(link, tie, share)| {
            let [i, j] = link.cameras;
            let covariance =
                rotated(&poses[i], &tie.covariance[0]) + rotated(&poses[j], &tie.covariance[1]);
            let residual = poses[i] * tie.point[0] - poses[j] * tie.point[1];
            let weight = match self.weighting {
                Weighting::Unweighted => Matrix3::identity() / common,
                Weighting::Covariance => {
                    let inverse = covariance.try_inverse().unwrap_or_else(Matrix3::zeros);
                    let sigmas = residual.dot(&(inverse * residual)).sqrt();
                    inverse * (share * (HUBER_SIGMAS / sigmas).min(1.0))
                }
            };
            Term { cameras: [i, j], tie, weight, covariance: covariance / share }
        });
        Weighted {
            terms: terms.collect(),
            floors: &self.floors,
            columns: self.columns(),
            parameters: self.free.iter().flatten().filter(|it| **it).count(),
        }
    }

    /// The mean variance of a residual in one direction, in square metres: it makes the landmarks
    /// of the unweighted cost comparable with the floors.
    fn common_variance(&self) -> f64 {
        let (mut sum, mut count) = (0.0, 0.0);
        for (_, tie, _) in self.ties() {
            sum += (tie.covariance[0].trace() + tie.covariance[1].trace()) / 3.0;
            count += 1.0;
        }
        if count > 0.0 { sum / count } else { 1.0 }
    }
}

/// The greatest displacement between two poses, in metres or radians.
fn distance(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    (a.translation.vector - b.translation.vector).norm().max(a.rotation.angle_to(&b.rotation))
}

/// A problem with fixed weights.
struct Weighted<'a> {
    terms: Vec<Term<'a>>,
    floors: &'a [Option<Floor>],
    columns: Vec<[Option<usize>; 6]>,
    parameters: usize,
}

/// A residual of a landmark and its weight.
struct Term<'a> {
    cameras: [usize; 2],
    tie: &'a Tie,
    weight: Matrix3<f64>,
    covariance: Matrix3<f64>,
}

impl Term<'_> {
    fn residual(&self, poses: &[Isometry3<f64>]) -> Vector3<f64> {
        let [i, j] = self.cameras;
        poses[i] * self.tie.point[0] - poses[j] * self.tie.point[1]
    }

    /// The two cameras with the derivatives of the residual by their poses.
    fn sides(&self, poses: &[Isometry3<f64>]) -> [(usize, Jacobian); 2] {
        let [i, j] = self.cameras;
        let [first, second] =
            [(i, 0), (j, 1)].map(|(camera, side)| jacobian(&poses[camera], &self.tie.point[side]));
        [(i, first), (j, -second)]
    }
}

/// The residuals of a floor, weighted: its normal against the z axis (x and y), and its height.
fn floor_residual(floor: &Floor, pose: &Isometry3<f64>) -> Vector3<f64> {
    let normal = pose.rotation * floor.normal.into_inner();
    let angle = 1.0 / floor.normal_sigma_rad;
    let height = (pose.translation.z - floor.height_m) / floor.height_sigma_m;
    Vector3::new(normal.x * angle, normal.y * angle, height)
}

/// The derivatives of [`floor_residual`].
fn floor_jacobian(floor: &Floor, pose: &Isometry3<f64>) -> Jacobian {
    let normal = pose.rotation * floor.normal.into_inner();
    let turn = -normal.cross_matrix() / floor.normal_sigma_rad;
    let mut jacobian = Jacobian::zeros();
    jacobian.fixed_view_mut::<2, 3>(0, 0).copy_from(&turn.fixed_rows::<2>(0));
    jacobian[(2, 5)] = 1.0 / floor.height_sigma_m;
    jacobian
}

/// The derivatives of a landmark's position in the optical frame by the errors of the floor: of its normal
/// along two axes, and of its height.
///
/// The landmark `p` lies on a fixed ray in the plane `n p + h = m`: with the errors it moves along the ray
/// by `-p (dn p + dh) / (n p)`.
fn placing_jacobian(floor: &Floor, axes: &[Vector3<f64>; 2], point: &Vector3<f64>) -> Matrix3<f64> {
    let along = point / -floor.normal.dot(point);
    Matrix3::from_columns(&[along * axes[0].dot(point), along * axes[1].dot(point), along])
}

/// The derivatives of [`floor_residual`] by the same errors.
fn floor_slope(floor: &Floor, axes: &[Vector3<f64>; 2], pose: &Isometry3<f64>) -> Matrix3<f64> {
    let [first, second] = axes.map(|axis| pose.rotation * axis / floor.normal_sigma_rad);
    Matrix3::new(
        first.x,
        second.x,
        0.0, //
        first.y,
        second.y,
        0.0, //
        0.0,
        0.0,
        -1.0 / floor.height_sigma_m,
    )
}

impl Weighted<'_> {
    /// `J^T W S W J` with the covariance S of the residuals that are independent: the normal equations'
    /// own noise.
    fn noise(&self, poses: &[Isometry3<f64>]) -> DMatrix<f64> {
        let has_own_noise = |floor: &Floor| floor.placing.is_none();
        self.sum(poses, |term| term.weight * term.covariance * term.weight, has_own_noise).1
    }

    /// The same of the errors of floors by which landmarks were placed: `M S M^T`, where S is the
    /// covariance of the floor and M the derivative of `J^T W r` by its error.
    fn common_noise(&self, poses: &[Isometry3<f64>]) -> DMatrix<f64> {
        let mut noise = DMatrix::zeros(self.parameters, self.parameters);
        for (camera, floor) in self.floors.iter().enumerate() {
            let Some((floor, covariance)) = floor.and_then(|it| Some((it, it.placing?))) else {
                continue;
            };
            let axes = FloorPlane::axes(&floor.normal);
            let mut slopes = MatrixXx3::<f64>::zeros(self.parameters);
            for term in self.terms.iter().filter(|term| term.cameras.contains(&camera)) {
                let side = usize::from(term.cameras[1] == camera);
                let sign = if side == 0 { 1.0 } else { -1.0 };
                let shift = placing_jacobian(&floor, &axes, &term.tie.point[side].coords);
                let turn = poses[camera].rotation.to_rotation_matrix();
                let weighted = term.weight * turn.matrix() * shift * sign;
                for (camera, jacobian) in term.sides(poses) {
                    let slope = jacobian.transpose() * weighted;
                    for (row, to_row) in self.free(camera) {
                        for error in 0..3 {
                            slopes[(to_row, error)] += slope[(row, error)];
                        }
                    }
                }
            }
            let slope = floor_jacobian(&floor, &poses[camera]).transpose()
                * floor_slope(&floor, &axes, &poses[camera]);
            for (row, to_row) in self.free(camera) {
                for error in 0..3 {
                    slopes[(to_row, error)] += slope[(row, error)];
                }
            }
            noise += &slopes * covariance * slopes.transpose();
        }
        noise
    }

    /// `J^T W r` and `J^T W J`, with these weights of the landmarks.
    fn sum(
        &self,
        poses: &[Isometry3<f64>],
        weight: impl Fn(&Term<'_>) -> Matrix3<f64>,
        counts: impl Fn(&Floor) -> bool,
    ) -> (DVector<f64>, DMatrix<f64>) {
        let mut gradient = DVector::zeros(self.parameters);
        let mut hessian = DMatrix::zeros(self.parameters, self.parameters);
        for term in &self.terms {
            let weight = weight(term);
            let weighted = weight * term.residual(poses);
            let sides = term.sides(poses);
            for (camera, ours) in &sides {
                let slope = ours.transpose() * weighted;
                for (row, column) in self.free(*camera) {
                    gradient[column] += slope[row];
                }
                for (other, theirs) in &sides {
                    let block = ours.transpose() * weight * theirs;
                    for (row, to_row) in self.free(*camera) {
                        for (column, to_column) in self.free(*other) {
                            hessian[(to_row, to_column)] += block[(row, column)];
                        }
                    }
                }
            }
        }
        for (camera, floor) in self.floors.iter().enumerate() {
            let Some(floor) = floor.as_ref().filter(|floor| counts(floor)) else { continue };
            let jacobian = floor_jacobian(floor, &poses[camera]);
            let slope = jacobian.transpose() * floor_residual(floor, &poses[camera]);
            let block = jacobian.transpose() * jacobian;
            for (row, to_row) in self.free(camera) {
                gradient[to_row] += slope[row];
                for (column, to_column) in self.free(camera) {
                    hessian[(to_row, to_column)] += block[(row, column)];
                }
            }
        }
        (gradient, hessian)
    }

    /// The free parameters of a camera: each with its index in the camera and in all.
    fn free(&self, camera: usize) -> impl Iterator<Item = (usize, usize)> + '_ {
        let columns = self.columns[camera].iter().enumerate();
        columns.filter_map(|(index, column)| Some((index, (*column)?)))
    }
}

impl LeastSquares for Weighted<'_> {
    type State = Vec<Isometry3<f64>>;

    fn normal_equations(&self, poses: &Self::State) -> (DVector<f64>, DMatrix<f64>) {
        self.sum(poses, |term| term.weight, |_| true)
    }

    fn cost(&self, poses: &Self::State) -> f64 {
        let landmarks = self.terms.iter().map(|term| {
            let residual = term.residual(poses);
            residual.dot(&(term.weight * residual))
        });
        let floors =
            self.floors.iter().zip(poses).filter_map(|(floor, pose)| {
                Some(floor_residual(floor.as_ref()?, pose).norm_squared())
            });
        landmarks.sum::<f64>() + floors.sum::<f64>()
    }

    fn moved(&self, poses: &Self::State, step: &DVector<f64>) -> Self::State {
        let of = |camera: usize, index: usize| {
            self.columns[camera][index].map_or(0.0, |column| step[column])
        };
        let moved = poses.iter().enumerate().map(|(camera, pose)| {
            tie::moved(pose, &Vector6::from_fn(|index, _| of(camera, index)))
        });
        moved.collect()
    }
}
