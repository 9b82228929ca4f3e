//! Scan matching: finds the pose from which the points of a distance vector fit the map's surfaces
//! best, and its covariance.
//!
//! First, all poses around the predicted one are scored in steps of one cell and 1.4 degrees, with
//! integer table look-ups: this finds the global optimum, and rivals that fit nearly as well. Then
//! the best pose is refined by least squares over the distances between points and lines along
//! surfaces (Censi's PL-ICP, ICRA 2008). The normal equations give the uncertainty of x, y and
//! heading; in a corridor, the position along it is unconstrained.
//!
//! Where the map is unknown, the surfaces that the robot itself has recently seen (its trail) are
//! used instead: each pose is found relative to earlier ones, and errors grow with the number of
//! new surfaces instead of with the distance driven. Against these alone a robot is followed from view to
//! view: its odometry is good for a second, so nothing is searched, and few points help.

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

use super::submaps::{self, Motion, motion, turned};
use geometry::{position, rotated};
use refinement::{CELL_DEVIATION, CELL_DEVIATION_MM, Hold, Refined, refine};
use search::{candidates, rivals};

pub(super) use geometry::line;
pub use {
    points::{Reading, points, readings},
    search::{Prior, Search},
    surfaces::Surfaces,
    trail::Trail,
};

/// Minimum number of points on surfaces in a match.
const MIN_POINTS: usize = 14;
/// The same while a robot is followed.
const MIN_FOLLOWED: usize = 5;
/// Minimum percentage of points on surfaces, among the points in known ground.
const MIN_SHARE: usize = 60;
/// The same in an unknown heading or after an unknown time, among all points.
const SURE_SHARE: usize = 90;
/// Search range for a robot that has not moved, except that its base may have rolled on for a moment: 6 cm and
/// 4 degrees, and standard deviations of 2 cm and 1.5 degrees. More would lead to wrong matches, as robots' walls
/// in blind ground may be a little askew.
const WHERE_IT_STOOD: Search = Search {
    position: Millimetres(60),
    turn: Angle(728),
    prior: Prior::Remembered(Millimetres(20), Angle(273)),
};
/// Maximum standard deviation of a match's heading: 2 degrees in radians.
const HEADING_LIMIT: f64 = 0.035;
/// Factor on the variance, because neighbouring points hit the same cells and are correlated.
const CORRELATION: f64 = 2.0;

/// The pose from which points were seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// The pose of `base_link` in `map`.
    pub pose: Pose,
    /// Covariance of x, y (mm) and heading (rad) in `map`; huge along a direction that the surfaces
    /// do not constrain.
    pub covariance: Matrix3<f64>,
}

impl Match {
    /// Standard deviations of x, y (mm) and heading (rad).
    pub fn deviations(&self) -> [f64; 3] {
        [0, 1, 2].map(|axis| self.covariance[(axis, axis)].sqrt())
    }

    /// Whether the surfaces determine the heading well enough for a robot to use it: to 2 degrees.
    pub fn is_sure(&self) -> bool {
        self.covariance[(2, 2)] <= HEADING_LIMIT * HEADING_LIMIT
    }

    /// The match in another frame, in which its own one is at `frame`.
    pub fn moved(self, frame: &Motion) -> Self {
        let turn = turned(frame.rotation.angle());
        let pose = submaps::pose(&(frame * motion(self.pose)));
        Self { pose, covariance: turn * self.covariance * turn.transpose() }
    }

    /// `None` if the surfaces do not constrain the pose at all.
    fn of(refined: &Refined) -> Option<Self> {
        let deviation = refined.square.max(CELL_DEVIATION_MM * CELL_DEVIATION_MM) * CORRELATION;
        // The small term keeps the matrix invertible; it is negligible for millimetres and radians.
        let inverse = (refined.information + Matrix3::identity() * 1e-9).try_inverse()?;
        let floor = Vector3::new(CELL_DEVIATION_MM, CELL_DEVIATION_MM, CELL_DEVIATION);
        let covariance = inverse * deviation + Matrix3::from_diagonal(&floor.component_mul(&floor));
        let pose = Pose {
            x: Millimetres(libm::round(refined.at.x) as i32),
            y: Millimetres(libm::round(refined.at.y) as i32),
            heading: Angle::from_radians(refined.heading),
        };
        Some(Self { pose, covariance })
    }
}

impl Surfaces {
    /// Finds the pose near the predicted one from which the points (from [`points`]) were seen.
    /// `None` if too few of them lie on surfaces, if the pose is ambiguous, or if its heading is
    /// too uncertain. Cost: about 2 ms for a search of 0.5 m and 15 degrees.
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

        if !self.fits(&points, &refined, MIN_POINTS) {
            return None;
        }
        let found = Match::of(&refined).filter(Match::is_sure)?;
        let rivals = rivals(&candidates, &best);
        let ambiguous = rivals.iter().any(|rival| {
            let (at, heading) = rival.pose(self, start, predicted.heading);
            let other = refine(self, &points, at, heading, hold);
            other.is_some_and(|other| other.is_elsewhere_and_as_good(&refined, &found.covariance))
        });
        (!ambiguous).then_some(found)
    }

    /// Follows a robot to the most likely pose near the predicted one, from which the points (from [`points`])
    /// were seen: no other place is tried. Where the surfaces do not constrain it, the pose is the predicted
    /// one, and the covariance huge. `None` if too few points lie on surfaces, or the best pose is beyond the
    /// search range. Cost: below 1 ms.
    pub fn follow(&self, points: &[[f64; 2]], predicted: Pose, search: Search) -> Option<Match> {
        let points: Vec<Vector2<f64>> = points.iter().map(|&[x, y]| Vector2::new(x, y)).collect();
        let (start, heading) = (position(predicted), predicted.heading.radians());
        let refined = refine(self, &points, start, heading, Hold::new(&search, predicted))?;
        let is_near = search.covers(self.resolution(), predicted, refined.at, refined.heading);
        (is_near && self.fits(&points, &refined, MIN_FOLLOWED)).then(|| Match::of(&refined))?
    }

    /// Whether at least `least` points lie on surfaces, and most of those in known ground.
    fn fits(&self, points: &[Vector2<f64>], refined: &Refined, least: usize) -> bool {
        let known = points.iter().filter(|point| {
            let arm = rotated(**point, refined.heading);
            let seen = refined.at + arm;
            self.code(self.cell(seen)) == Cell::Free || self.seen_along(arm, seen).is_some()
        });
        refined.points >= least && 100 * refined.points >= MIN_SHARE * known.count()
    }

    /// Finds the pose within 0.8 m of a place, in any heading, from which the points were seen. As many poses
    /// may fit by chance, nearly all points must lie on surfaces; in a furnished room 3 of 100 matches are wrong
    /// nevertheless. Tries six times as many headings as a search of 30 degrees to both sides.
    pub fn find_in_any_heading(&self, points: &[[f64; 2]], about: Pose) -> Option<Match> {
        let turn = Angle(i16::MAX as u16);
        let search = Search { position: Millimetres(800), turn, prior: Prior::Nothing };
        self.find(points, about, search).filter(|found| self.is_view(points, found.pose))
    }

    /// Finds the pose of a robot that stood, and has most likely not moved since, near that pose: from there
    /// nearly all points must lie on surfaces. Views that would fit many other places are of use as well.
    pub fn find_where_it_stood(&self, points: &[[f64; 2]], stood: Pose) -> Option<Match> {
        self.find(points, stood, WHERE_IT_STOOD).filter(|found| self.is_view(points, found.pose))
    }

    /// Whether nearly all points lie on surfaces if seen from a pose, and none contradicts it.
    fn is_view(&self, points: &[[f64; 2]], pose: Pose) -> bool {
        let (agree, contradict) = self.agreement(points, pose);
        contradict == 0 && 100 * agree as usize >= SURE_SHARE * points.len()
    }
}

#[cfg(test)]
mod tests;
