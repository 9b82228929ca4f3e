//! The pose of a robot from its marker in one calibrated camera: on the floor the pose has only x, y and
//! heading, and the height of the marker is known.

use libm::{atan2, hypot, sincos, sqrt};
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Point3, Vector2, Vector3};

use super::marker::Marker;
use crate::camera::Lens;

/// Maximum number of Gauss-Newton steps; three are usually enough.
const STEPS: usize = 10;
/// The fit has converged when every component of a step is below this, in metres and radians.
const SETTLED: f64 = 1e-9;
/// Step of the numerical derivative of the projection, in metres.
const STEP_M: f64 = 1e-4;
/// Maximum reduced chi-squared of the residuals. With five degrees of freedom, noise exceeds it for
/// one tag in two million.
const MAX_CHI_SQUARED: f64 = 7.5;
/// Weight of the prior noise estimate, as a number of residuals.
const PRIOR_WEIGHT: f64 = 10.0;

/// The pose of a robot and its covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// `base_link` in `map`, in metres.
    pub position_m: [f64; 2],
    /// The heading, counter-clockwise from the x axis of `map`, in radians.
    pub heading_rad: f64,
    /// Covariance of x, y (metres) and heading (radians).
    pub covariance: Matrix3<f64>,
}

/// Why a marker's points give no pose.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum NotThere {
    /// No pose explains the points.
    #[error("no pose of the marker explains its points")]
    NoPose,
    /// The residuals of the best pose, in pixels, are larger than noise: the marker is not level,
    /// or its registered height or size is wrong.
    #[error("residuals of {0:.2} pixels: the marker is not level, or its height or size is wrong")]
    Residual(f64),
}

/// The robot's pose from a marker with points at `points` in `base_link` (metres), at `height_m` above the
/// floor. Minimises the squared reprojection error; the covariance follows from the noise of the
/// residuals.
///
/// # Errors
/// Every [`NotThere`].
pub fn locate(
    lens: &Lens,
    marker: &Marker,
    points: &[[f64; 2]],
    height_m: f64,
) -> Result<Placement, NotThere> {
    if marker.points.len() != points.len() || points.len() < 2 {
        return Err(NotThere::NoPose);
    }
    let mut state = first_guess(lens, marker, points, height_m).ok_or(NotThere::NoPose)?;
    for _ in 0..STEPS {
        let fit = Fit::at(&state, lens, marker, points, height_m).ok_or(NotThere::NoPose)?;
        let inverse = fit.information.try_inverse().ok_or(NotThere::NoPose)?;
        let step = inverse * fit.gradient;
        state += step;
        if step.amax() < SETTLED {
            break;
        }
    }
    let fit = Fit::at(&state, lens, marker, points, height_m).ok_or(NotThere::NoPose)?;
    let freedom = (2 * points.len() - 3) as f64;
    let variance = marker.noise_px * marker.noise_px;
    let excess = fit.squares / (variance * freedom);
    if excess > MAX_CHI_SQUARED || excess.is_nan() {
        return Err(NotThere::Residual(sqrt(fit.squares / (2 * points.len()) as f64)));
    }
    let variance = (PRIOR_WEIGHT * variance + fit.squares) / (PRIOR_WEIGHT + freedom);
    let inverse = fit.information.try_inverse().ok_or(NotThere::NoPose)?;
    Ok(Placement {
        position_m: [state.x, state.y],
        heading_rad: state.z,
        covariance: inverse * variance,
    })
}

/// The rigid motion that best maps the points onto the intersections of their rays with the marker's plane.
fn first_guess(
    lens: &Lens,
    marker: &Marker,
    points: &[[f64; 2]],
    height_m: f64,
) -> Option<Vector3<f64>> {
    let seen = marker.points.iter().map(|&pixel| on_plane(lens, pixel, height_m));
    let seen: Vec<Vector2<f64>> = seen.collect::<Option<_>>()?;
    let known = || points.iter().map(|&point| Vector2::from(point));
    let count = points.len() as f64;
    let seen_middle = seen.iter().sum::<Vector2<f64>>() / count;
    let known_middle = known().sum::<Vector2<f64>>() / count;
    let (mut along, mut across) = (0.0, 0.0);
    for (seen, known) in seen.iter().zip(known()) {
        let (to, from) = (seen - seen_middle, known - known_middle);
        along += from.dot(&to);
        across += from.perp(&to);
    }
    let heading = atan2(across, along);
    let (sine, cosine) = sincos(heading);
    let position = seen_middle - Matrix2::new(cosine, -sine, sine, cosine) * known_middle;
    Some(Vector3::new(position.x, position.y, heading))
}

/// The point at `height_m` in `map` that a pixel sees; `None` if its ray does not meet that plane.
pub(super) fn on_plane(lens: &Lens, pixel: [f64; 2], height_m: f64) -> Option<Vector2<f64>> {
    let (eye, way) = (lens.centre(), lens.direction(pixel));
    let depth = (height_m - eye.z) / way.z;
    (depth > 0.0 && depth.is_finite()).then(|| (eye + way * depth).coords.xy())
}

/// The normal equations of the least squares at one pose.
struct Fit {
    information: Matrix3<f64>,
    gradient: Vector3<f64>,
    /// Sum of the squared residuals, in square pixels.
    squares: f64,
}

impl Fit {
    fn at(
        state: &Vector3<f64>,
        lens: &Lens,
        marker: &Marker,
        points: &[[f64; 2]],
        height_m: f64,
    ) -> Option<Self> {
        let (sine, cosine) = sincos(state.z);
        let mut fit =
            Self { information: Matrix3::zeros(), gradient: Vector3::zeros(), squares: 0.0 };
        for (&[ahead, left], &pixel) in points.iter().zip(&marker.points) {
            let from_middle =
                Vector2::new(cosine * ahead - sine * left, sine * ahead + cosine * left);
            let place = state.xy() + from_middle;
            let project = |dx: f64, dy: f64| {
                let point = Point3::new(place.x + dx, place.y + dy, height_m);
                lens.project(&point).map(Vector2::from)
            };
            let residual = Vector2::from(pixel) - project(0.0, 0.0)?;
            let by_x = (project(STEP_M, 0.0)? - project(-STEP_M, 0.0)?) / (2.0 * STEP_M);
            let by_y = (project(0.0, STEP_M)? - project(0.0, -STEP_M)?) / (2.0 * STEP_M);
            let by_heading = by_y * from_middle.x - by_x * from_middle.y;
            let jacobian = Matrix2x3::from_columns(&[by_x, by_y, by_heading]);
            fit.information += jacobian.transpose() * jacobian;
            fit.gradient += jacobian.transpose() * residual;
            fit.squares += residual.norm_squared();
        }
        Some(fit)
    }
}

impl Placement {
    /// Distance between the positions, in metres.
    pub fn distance_m(&self, other: &Self) -> f64 {
        let ([x, y], [other_x, other_y]) = (self.position_m, other.position_m);
        hypot(x - other_x, y - other_y)
    }
}
