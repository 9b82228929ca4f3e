//! Least squares over the distances between points and lines along surfaces.

use nalgebra::{Matrix3, Vector2, Vector3};
use ubimap_protocol::units::{Angle, Pose};

use super::{
    geometry::{self, rotated},
    search::{Prior, RIVAL_SCORE, Search},
    surfaces::{Surface, Surfaces},
};

/// Minimum squared distance, in standard deviations, between two different poses: chi-squared with
/// three degrees of freedom at a probability of 1 in 10,000.
const ELSEWHERE: f64 = 21.1;
/// Maximum distance of a point from its surface in the first rounds, in millimetres.
const FIRST_REACH_MM: f64 = 250.0;
/// Maximum distance in the other rounds, when the pose is nearly right.
const LAST_REACH_MM: f64 = 100.0;
/// Number of refinement rounds.
const ROUNDS: usize = 14;
/// Number of rounds with the first reach.
const FIRST_ROUNDS: usize = 6;
/// Systematic position error of surfaces drawn in cells, in millimetres: it does not average out
/// over the points.
pub(super) const CELL_DEVIATION_MM: f64 = 15.0;
/// Systematic heading error of surfaces drawn in cells, in radians.
pub(super) const CELL_DEVIATION: f64 = 0.004;

/// The prior that holds a match to the predicted pose.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hold {
    at: Vector2<f64>,
    heading: f64,
    /// Information (inverse variance) of x, y and heading, multiplied by the variance of a point,
    /// the square of [`CELL_DEVIATION_MM`].
    information: Vector3<f64>,
    /// Whether the prior contributes to the result's certainty.
    counts: bool,
}

/// Result of a refinement.
pub(super) struct Refined {
    pub(super) at: Vector2<f64>,
    pub(super) heading: f64,
    /// Matrix of the normal equations, with weight 1 for a point on its surface. The covariance of
    /// the pose is its inverse, multiplied by the variance of the points' distances.
    pub(super) information: Matrix3<f64>,
    pub(super) points: usize,
    /// Mean squared distance of the points, in square millimetres.
    pub(super) square: f64,
}

impl Hold {
    /// The prior of a search. The deviations of [`Prior::Carried`] are raised to at least 5 mm and
    /// 0.1 degrees.
    pub(super) fn new(search: &Search, predicted: Pose) -> Self {
        let information = |deviation: f64| (CELL_DEVIATION_MM / deviation).powi(2);
        let position = match search.prior {
            Prior::Carried(deviation, _) => f64::from(deviation.0).max(5.0),
            _ => search.deviations().0,
        };
        let heading = match search.prior {
            Prior::Carried(_, deviation) | Prior::Remembered(_, deviation) => {
                information(deviation.radians().max(2e-3))
            }
            Prior::Measured(_) | Prior::Nothing => 0.0,
        };
        Self {
            at: geometry::position(predicted),
            heading: predicted.heading.radians(),
            information: Vector3::new(information(position), information(position), heading),
            counts: matches!(search.prior, Prior::Measured(_) | Prior::Remembered(..)),
        }
    }
}

impl Refined {
    /// Whether this is a different pose from `best`, whose covariance is given, and fits nearly as
    /// well.
    pub(super) fn is_elsewhere_and_as_good(&self, best: &Self, covariance: &Matrix3<f64>) -> bool {
        let (dx, dy) = (self.at.x - best.at.x, self.at.y - best.at.y);
        let off = Vector3::new(dx, dy, self.heading - best.heading);
        // Along an unconstrained direction, all positions count as the same.
        let distance = covariance.try_inverse().map_or(0.0, |inverse| off.dot(&(inverse * off)));
        let as_good = 100 * self.points >= RIVAL_SCORE as usize * best.points
            && self.square <= 2.0 * best.square.max(CELL_DEVIATION_MM * CELL_DEVIATION_MM);
        as_good && distance > ELSEWHERE
    }
}

/// Refines the pose `at`, `heading` so that the points (in `base_link`) fit the surfaces best.
/// `None` if the equations can't be solved.
pub(super) fn refine(
    surfaces: &Surfaces,
    points: &[Vector2<f64>],
    mut at: Vector2<f64>,
    mut heading: f64,
    hold: Hold,
) -> Option<Refined> {
    let mut refined = None;
    for round in 0..ROUNDS {
        let reach = if round < FIRST_ROUNDS { FIRST_REACH_MM } else { LAST_REACH_MM };
        let (mut information, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
        let (mut count, mut squares) = (0, 0.0);
        for point in points {
            let arm = rotated(*point, heading);
            let Some(&Surface { middle, normal }) = surfaces.seen_along(arm, at + arm) else {
                continue;
            };
            let off = at + arm - middle;
            let (axes, share): ([Option<Vector2<f64>>; 2], f64) = match normal {
                Some(normal) => ([Some(normal), None], 1.0),
                None => ([Some(Vector2::x()), Some(Vector2::y())], 0.25),
            };
            let mut counts = true;
            for axis in axes.into_iter().flatten() {
                let distance = axis.dot(&off);
                let part = distance / reach;
                if part.abs() >= 1.0 {
                    counts = false;
                    continue;
                }
                let weight = (1.0 - part * part).powi(2) * share;
                let row = Vector3::new(axis.x, axis.y, axis.dot(&Vector2::new(-arm.y, arm.x)));
                information += row * row.transpose() * weight;
                gradient += row * (distance * weight);
                squares += distance * distance * share;
            }
            count += usize::from(counts);
        }
        // The prior holds the pose in unconstrained directions.
        let back = hold.at - at;
        let turn = Angle::from_radians(hold.heading - heading).radians();
        let held = information + Matrix3::from_diagonal(&hold.information);
        gradient -= hold.information.component_mul(&Vector3::new(back.x, back.y, turn));
        let regular = held + Matrix3::from_diagonal(&Vector3::z());
        let step = regular.try_inverse()? * gradient;
        let information = if hold.counts { held } else { information };
        at -= Vector2::new(step.x, step.y);
        heading -= step.z;
        let square = squares / f64::from(count.max(1) as u32);
        refined = Some(Refined { at, heading, information, points: count, square });
    }
    refined
}
