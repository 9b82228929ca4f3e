//! What a robot saw against the map: the pose from which the points of a distance vector lie best
//! on the surfaces of the map, and how sure that is.
//!
//! First every pose about the predicted one is tried, in steps of a cell and 1.4 degrees, with
//! looked-up integer scores: so a better place is found wherever it is, and a second place that is
//! nearly as good is noticed. Then the best is refined by least squares of the distances between
//! points and lines along the surfaces (Censi's PL-ICP, ICRA 2008). Their normal equations tell
//! what the surfaces say of x, y and heading: in a corridor nothing of the way along it.
//!
//! Where the map says nothing, what the robot has seen from its last places stands for it: so each
//! place is found from those before it, and errors grow with the surfaces that come into view, not
//! with the way of the wheels.

mod geometry;
mod points;
mod refinement;
mod search;
mod surfaces;
mod trail;

use nalgebra::{Matrix3, Vector2, Vector3};
use ubimap_protocol::{
    tile::Cell,
    units::{Angle, Millimetres, Pose},
};

use geometry::{position, rotated};
use refinement::{CELL_DEVIATION, CELL_DEVIATION_MM, Hold, refine};
use search::{candidates, rivals};

pub use {
    points::points,
    search::{Prior, Search},
    surfaces::Surfaces,
    trail::Trail,
};

/// A match stands on so many points at least, and so many hundredths of those in known ground.
const LEAST_POINTS: usize = 14;
const LEAST_SHARE: usize = 60;
/// A match whose heading is less sure than this is none: 2 degrees.
const HEADING_LIMIT: f64 = 0.035;
/// A point stands for less than a measurement of its own, for its neighbours hit the same cells.
const CORRELATION: f64 = 2.0;

/// From where the points were seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// `base_link` in `map`.
    pub pose: Pose,
    /// Of x, y (mm) and heading (rad) in `map`. Where the surfaces say nothing of a direction, it
    /// is huge.
    pub covariance: Matrix3<f64>,
}

impl Match {
    /// Standard deviations of x, y (mm) and heading (rad).
    pub fn deviations(&self) -> [f64; 3] {
        [0, 1, 2].map(|axis| self.covariance[(axis, axis)].sqrt())
    }
}

impl Surfaces {
    /// The pose about the predicted one from which the points (as of [`points`]) were seen. `None`
    /// if too little of them lies on surfaces, or if there are two such poses or more, or if they
    /// say too little of the heading. A search of half a metre and 15 degrees takes about two
    /// milliseconds.
    pub fn find(&self, points: &[[f64; 2]], predicted: Pose, search: Search) -> Option<Match> {
        let points: Vec<Vector2<f64>> = points.iter().map(|&[x, y]| Vector2::new(x, y)).collect();
        let start = position(predicted);
        let candidates = candidates(self, &points, start, predicted.heading, search);
        let best = *candidates.iter().max_by_key(|it| it.score - it.away)?;
        let hold = Hold::new(&search, predicted);
        let (at, heading) = best.pose(self, start, predicted.heading);
        let refined = refine(self, &points, at, heading, hold)?;
        if !search.covers(self.resolution(), predicted, refined.at, refined.heading) {
            return None;
        }

        let known = points.iter().filter(|point| {
            let arm = rotated(**point, refined.heading);
            let seen = refined.at + arm;
            self.code(self.cell(seen)) == Cell::Free || self.seen_along(arm, seen).is_some()
        });
        if refined.points < LEAST_POINTS || 100 * refined.points < LEAST_SHARE * known.count() {
            return None;
        }
        let deviation = refined.square.max(CELL_DEVIATION_MM * CELL_DEVIATION_MM) * CORRELATION;
        // A metre and more of the position must not count for a radian.
        let inverse = (refined.information + Matrix3::identity() * 1e-9).try_inverse()?;
        let floor = Vector3::new(CELL_DEVIATION_MM, CELL_DEVIATION_MM, CELL_DEVIATION);
        let covariance = inverse * deviation + Matrix3::from_diagonal(&floor.component_mul(&floor));
        if covariance[(2, 2)] > HEADING_LIMIT * HEADING_LIMIT {
            return None;
        }
        let rivals = rivals(&candidates, &best);
        let ambiguous = rivals.iter().any(|rival| {
            let (at, heading) = rival.pose(self, start, predicted.heading);
            let other = refine(self, &points, at, heading, hold);
            other.is_some_and(|other| other.is_elsewhere_and_as_good(&refined, &covariance))
        });
        if ambiguous {
            return None;
        }
        let pose = Pose {
            x: Millimetres(libm::round(refined.at.x) as i32),
            y: Millimetres(libm::round(refined.at.y) as i32),
            heading: Angle::from_radians(refined.heading),
        };
        Some(Match { pose, covariance })
    }
}

#[cfg(test)]
mod tests;
