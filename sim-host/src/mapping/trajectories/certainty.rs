//! How sure it is where a piece is: what a match may say of it.
//!
//! The marginal covariances of the whole graph cost too much. Instead a piece is as sure as the last one before it that
//! something else than steps held in place, and the steps since then.

use nalgebra::{Matrix3, Vector3};

use super::{FIRST, Trajectories};
use crate::mapping::submaps::{Edge, Measured, Refined, difference};

/// Squared Mahalanobis distance beyond which a match contradicts where the pieces are: chi-squared with three degrees of
/// freedom at 99 %.
const PLAUSIBLE: f64 = 11.3;
/// What matches leave, however many there are, since the other pieces are off by this themselves: deviations in metres and
/// radians.
const LEFT: [f64; 3] = [0.03, 0.03, 0.01];

/// The matches of a piece.
#[derive(Debug)]
pub(super) struct Matches {
    /// Where the piece is without them.
    pub(super) believed: Measured,
    pub(super) edges: Vec<Edge>,
    /// With which covariance in the map each puts the piece.
    pub(super) covariances: Vec<Matrix3<f64>>,
}

impl Trajectories {
    /// The pose of a piece in the map by the steps from the last piece before it that was held, or from itself, if
    /// `is_own` and it is held.
    pub(super) fn believed(&self, number: usize, is_own: bool) -> Measured {
        let pieces = &self.robots[&self.pieces[number].robot].pieces;
        let end = pieces.partition_point(|it| *it < number);
        let begin = pieces[..end + usize::from(is_own)]
            .iter()
            .rposition(|it| self.pieces[*it].held.is_some())
            .unwrap_or(0);
        let (first, poses) = (pieces[begin], &self.graph.poses);
        let held = self.pieces[first].held.unwrap_or_else(|| covariance(FIRST));
        let mut believed = Measured { motion: poses[first], covariance: held };
        for pair in pieces[begin..=end].windows(2) {
            let motion = poses[pair[0]].inv_mul(&poses[pair[1]]);
            let step = Measured { motion, covariance: self.pieces[pair[1]].step };
            believed = believed.then(&step);
        }
        believed
    }

    /// With which covariance in the map a match with another piece puts one, if that is where it may be.
    pub(super) fn plausible(
        &self,
        believed: &Measured,
        (number, other): (usize, usize),
        refined: &Refined,
    ) -> Option<Matrix3<f64>> {
        let poses = &self.graph.poses;
        let off = difference(&poses[other].inv_mul(&poses[number]), &refined.motion);
        let other = self.believed(other, true);
        let sum = other.inverse().then(believed).covariance + refined.covariance;
        (off.dot(&(sum.try_inverse()? * off)) <= PLAUSIBLE).then(|| {
            let covariance = refined.covariance + covariance(LEFT);
            other.then(&Measured { motion: refined.motion, covariance }).covariance
        })
    }

    /// Holds a piece where it is, as sure as the surest of its matches makes it: their errors have the same causes.
    pub(super) fn hold(&mut self, number: usize, found: &Matches) {
        let both = |its: &Matrix3<f64>| {
            (found.believed.covariance.try_inverse()? + its.try_inverse()?).try_inverse()
        };
        self.pieces[number].held = found
            .covariances
            .iter()
            .filter_map(both)
            .min_by(|a, b| a.determinant().total_cmp(&b.determinant()));
    }
}

/// The covariance of independent deviations of x, y and heading.
pub(super) fn covariance(deviations: [f64; 3]) -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::from(deviations.map(|it| it * it)))
}
