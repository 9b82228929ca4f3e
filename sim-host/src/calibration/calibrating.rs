//! From observations to the cameras' poses.

use nalgebra::{Isometry3, Matrix6};

use super::{
    frame::Frame,
    graph::{Edge, propagate},
    observations::{Floor, Observations, ObservationsError},
    pairing::{PairFault, PairwiseOptions},
    pairwise::pair_transform,
    refine::{Problem, Refined, Weighting},
    sharing::links,
    tie::Tie,
};
use crate::perception::FloorError;

/// How cameras are calibrated.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Options {
    /// The index of the reference camera, which defines `R0`.
    pub reference: usize,
    /// The known pose of the reference camera's optical frame in `map`, in metres. Without it, the
    /// floor gives height, tilt and roll if any camera sees it; x, y and heading of the reference
    /// are zero.
    pub reference_pose: Option<Isometry3<f64>>,
    /// How residuals are weighted.
    pub weighting: Weighting,
    /// How landmarks of two cameras are paired.
    pub pairwise: PairwiseOptions,
}

/// The result of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibrated {
    /// Each camera of the observations.
    pub cameras: Vec<CalibratedCamera>,
    /// Each pair of cameras that a transform ties.
    pub edges: Vec<CalibratedEdge>,
    /// Each pair of cameras with landmarks but without a transform.
    pub failures: Vec<Failure>,
    /// The ratio of the residuals to their stated noise, with which the covariances are scaled.
    pub noise_ratio: f64,
}

/// A camera after calibration.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CalibratedCamera {
    /// The pose of the optical frame in `R0`, the paper's `T_0k`, in metres. `None` if no path of
    /// overlaps ties the camera to the reference.
    pub pose: Option<Isometry3<f64>>,
    /// The pose along the best path, before the global optimisation.
    pub propagated: Option<Isometry3<f64>>,
    /// The covariance of the pose about and along the axes of `R0`, in radians and metres, relative
    /// to the reference.
    pub covariance: Matrix6<f64>,
    /// Root mean square of the distances between this camera's landmarks and its neighbours', in
    /// metres.
    pub residual_m: f64,
    /// Number of its landmarks that tie it to a neighbour.
    pub landmarks: usize,
    /// The cameras that share landmarks with it.
    pub neighbours: Vec<usize>,
    /// How far its floor is from z = 0, if it sees the floor.
    pub floor: Option<FloorError>,
}

/// A pair of cameras after calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct CalibratedEdge {
    /// The pairwise transform.
    pub edge: Edge,
    /// Root mean square of the distances between the landmarks of both, in metres.
    pub residual_m: f64,
}

/// A pair of cameras without a transform.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Failure {
    /// The indices of the cameras.
    pub cameras: [usize; 2],
    /// The reason.
    pub fault: PairFault,
}

/// Why cameras can't be calibrated.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// Observations can't be used.
    #[error(transparent)]
    Observations(#[from] ObservationsError),
    /// The reference is no camera.
    #[error("no camera has the index {0} of the reference")]
    Reference(usize),
    /// No camera is tied to the reference.
    #[error("no overlap ties a camera to the reference {reference}{}", because(.fault))]
    Alone {
        /// The reference's name.
        reference: String,
        /// The name of the camera that shares the most landmarks with it, and why that fails.
        fault: Option<(String, PairFault)>,
    },
    /// The landmarks do not determine the poses.
    #[error("the landmarks do not determine all poses; add landmarks, or another reference")]
    Undetermined,
}

fn because(fault: &Option<(String, PairFault)>) -> String {
    fault.as_ref().map_or(String::new(), |(name, fault)| format!(" (with {name}: {fault})"))
}

/// Median squared Mahalanobis distance at which an edge contradicts the others: with noise alone it
/// is 2.4.
const CONTRADICTION: f64 = 25.0;

/// Calibrates the cameras: pairwise transforms, propagation, and global optimisation.
///
/// # Errors
/// Every [`CalibrateError`].
pub fn calibrate(
    observations: &Observations,
    options: &Options,
) -> Result<Calibrated, CalibrateError> {
    observations.check()?;
    let reference = options.reference;
    if reference >= observations.cameras.len() {
        return Err(CalibrateError::Reference(reference));
    }
    let (mut edges, mut failures) = pair_all(observations, &options.pairwise);
    loop {
        let solution = solve(observations, options, &edges)
            .map_err(|unsolved| unsolved.explain(observations, reference, &failures))?;
        let Some(worst) = solution.contradiction() else {
            return Ok(solution.conclude(observations, &edges, failures));
        };
        let cameras = edges.remove(worst).cameras;
        failures.push(Failure { cameras, fault: PairFault::Contradiction });
    }
}

/// The transforms of all pairs of cameras.
fn pair_all(observations: &Observations, options: &PairwiseOptions) -> (Vec<Edge>, Vec<Failure>) {
    let cameras = &observations.cameras;
    let (mut edges, mut failures) = (Vec::new(), Vec::new());
    for i in 0..cameras.len() {
        for j in i + 1..cameras.len() {
            match pair_transform([&cameras[i], &cameras[j]], options) {
                Ok(transform) => edges.push(Edge { cameras: [i, j], transform }),
                Err(PairFault::TooFew { shared: 0 }) => {}
                Err(fault) => failures.push(Failure { cameras: [i, j], fault }),
            }
        }
    }
    (edges, failures)
}

/// Why there is no solution.
enum Unsolved {
    Alone,
    Undetermined,
}

impl Unsolved {
    fn explain(
        self,
        observations: &Observations,
        reference: usize,
        failures: &[Failure],
    ) -> CalibrateError {
        let name = |camera: usize| observations.cameras[camera].name.clone();
        match self {
            Self::Undetermined => CalibrateError::Undetermined,
            Self::Alone => {
                let of_reference = failures.iter().filter(|it| it.cameras.contains(&reference));
                let fault = of_reference.max_by_key(|it| it.fault.shared()).map(|it| {
                    let [i, j] = it.cameras;
                    (name(if i == reference { j } else { i }), it.fault)
                });
                CalibrateError::Alone { reference: name(reference), fault }
            }
        }
    }
}

/// Poses in `R0`, and what they come from.
struct Solution {
    propagated: Vec<Option<Isometry3<f64>>>,
    refined: Refined,
    /// The ties of each edge; none if the edge is not tied to the reference.
    ties: Vec<Vec<Tie>>,
    cameras: Vec<[usize; 2]>,
}

fn solve(
    observations: &Observations,
    options: &Options,
    edges: &[Edge],
) -> Result<Solution, Unsolved> {
    let count = observations.cameras.len();
    let reference = options.reference;
    let start = options.reference_pose.unwrap_or_else(Frame::level);
    let propagated = propagate(count, edges, reference, start);
    let tied: Vec<bool> = propagated.iter().map(Option::is_some).collect();
    let is_tied = |camera: usize| tied[camera];
    if !(0..count).any(|it| it != reference && is_tied(it)) {
        return Err(Unsolved::Alone);
    }
    let floor = |camera: usize| observations.cameras[camera].floor.filter(|_| is_tied(camera));
    let floors: Vec<Option<Floor>> = (0..count).map(floor).collect();
    let frame = match options.reference_pose {
        Some(_) => Frame::Known,
        None => Frame::of_floor(&propagated, &floors, reference),
    };
    let propagated = frame.align(&propagated, reference);
    let links = links(observations, edges, &is_tied);
    let free = (0..count).map(|camera| match camera {
        _ if !is_tied(camera) => [false; 6],
        _ if camera == reference => frame.free(),
        _ => [true; 6],
    });
    let problem =
        Problem { links: &links, floors, free: free.collect(), weighting: options.weighting };
    let start: Vec<Isometry3<f64>> =
        propagated.iter().map(|it| it.unwrap_or_else(Isometry3::identity)).collect();
    let mut refined = problem.refine(&start).ok_or(Unsolved::Undetermined)?;
    frame.settle(&mut refined, reference);
    let (cameras, ties) = links.into_iter().map(|link| (link.cameras, link.ties)).unzip();
    Ok(Solution { propagated, refined, ties, cameras })
}

impl Solution {
    /// The index of the edge that contradicts the others most, if any does.
    fn contradiction(&self) -> Option<usize> {
        let medians = self.ties.iter().zip(&self.cameras).map(|(ties, &cameras)| {
            let t_ij = self.transform(cameras);
            let mut distances: Vec<f64> = ties.iter().map(|it| it.distance2(&t_ij)).collect();
            distances.sort_by(f64::total_cmp);
            distances.get(distances.len() / 2).copied().unwrap_or(0.0)
        });
        let limit = CONTRADICTION * self.refined.noise_ratio.max(1.0);
        let worst = medians.enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
        (worst.1 > limit).then_some(worst.0)
    }

    fn transform(&self, [i, j]: [usize; 2]) -> Isometry3<f64> {
        self.refined.poses[i].inv_mul(&self.refined.poses[j])
    }

    fn conclude(
        self,
        observations: &Observations,
        edges: &[Edge],
        failures: Vec<Failure>,
    ) -> Calibrated {
        let rms = |edges: &mut dyn Iterator<Item = usize>| {
            let (mut sum, mut count) = (0.0, 0.0);
            for edge in edges {
                let t_ij = self.transform(self.cameras[edge]);
                sum +=
                    self.ties[edge].iter().map(|it| it.residual(&t_ij).norm_squared()).sum::<f64>();
                count += self.ties[edge].len() as f64;
            }
            if count > 0.0 { (sum / count).sqrt() } else { 0.0 }
        };
        let cameras = (0..observations.cameras.len()).map(|camera| {
            if self.propagated[camera].is_none() {
                return CalibratedCamera::default();
            }
            let of_camera = || (0..edges.len()).filter(|&it| self.cameras[it].contains(&camera));
            let mut landmarks: Vec<usize> = of_camera()
                .flat_map(|edge| {
                    let side = usize::from(self.cameras[edge][1] == camera);
                    self.ties[edge].iter().map(move |it| it.index[side])
                })
                .collect();
            landmarks.sort_unstable();
            landmarks.dedup();
            let pose = self.refined.poses[camera];
            let neighbour = |edge: usize| self.cameras[edge].into_iter().find(|it| *it != camera);
            CalibratedCamera {
                pose: Some(pose),
                propagated: self.propagated[camera],
                covariance: self.refined.covariances[camera],
                residual_m: rms(&mut of_camera()),
                landmarks: landmarks.len(),
                neighbours: of_camera().filter_map(neighbour).collect(),
                floor: floor_error(observations.cameras[camera].floor, &pose),
            }
        });
        let after = edges.iter().enumerate().filter(|(index, _)| !self.ties[*index].is_empty());
        Calibrated {
            cameras: cameras.collect(),
            edges: after
                .map(|(index, edge)| CalibratedEdge {
                    edge: edge.clone(),
                    residual_m: rms(&mut std::iter::once(index)),
                })
                .collect(),
            failures,
            noise_ratio: self.refined.noise_ratio,
        }
    }
}

impl CalibratedCamera {
    /// Standard deviation of the position, in metres: the root of the sum over the axes.
    pub fn position_sigma_m(&self) -> f64 {
        self.sigma(3)
    }

    /// Standard deviation of the angles, in radians: the root of the sum over the axes.
    pub fn angle_sigma_rad(&self) -> f64 {
        self.sigma(0)
    }

    fn sigma(&self, from: usize) -> f64 {
        self.covariance.diagonal().fixed_rows::<3>(from).sum().max(0.0).sqrt()
    }
}

impl Calibrated {
    /// The indices of the cameras that no path of overlaps ties to the reference.
    pub fn untied(&self) -> impl Iterator<Item = usize> + '_ {
        self.cameras.iter().enumerate().filter(|(_, it)| it.pose.is_none()).map(|(index, _)| index)
    }
}

fn floor_error(floor: Option<Floor>, pose: &Isometry3<f64>) -> Option<FloorError> {
    floor.map(|floor| FloorError::new(pose, &floor.normal, floor.height_m))
}
