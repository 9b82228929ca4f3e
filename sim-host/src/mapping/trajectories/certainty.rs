//! How sure it is where a piece is: what a match may say of it.
//!
//! The marginal covariances of the whole graph cost too much. Instead a piece is as sure as the last one before it that
//! something else than steps held in place, and the steps since then.

use nalgebra::Matrix3;

use super::{
    Trajectories,
    matches::{Matches, covariance},
};
use crate::mapping::submaps::{Edge, Measured, Refined, difference};

/// Squared Mahalanobis distance beyond which a match contradicts where the pieces are: chi-squared with three degrees of
/// freedom at 99 %.
const PLAUSIBLE: f64 = 11.3;
/// What matches leave, however many there are, since the other pieces are off by this themselves: deviations in metres and
/// radians.
const LEFT: [f64; 3] = [0.03, 0.03, 0.01];

impl Trajectories {
    /// The pose of a piece in the map by the steps from the last piece before it that was held.
    pub(super) fn predicted(&self, number: usize) -> Measured {
        let pieces = &self.robots[&self.pieces[number].robot].pieces;
        self.followed(&pieces[..=pieces.partition_point(|it| *it < number)], false)
    }

    /// The same, or as sure as the piece is held itself.
    pub(super) fn believed(&self, number: usize) -> Measured {
        let pieces = &self.robots[&self.pieces[number].robot].pieces;
        self.followed(&pieces[..=pieces.partition_point(|it| *it < number)], true)
    }

    /// The last of a robot's pieces, from the last one that is held, or from the first. `is_own` says whether the last one
    /// counts among these.
    fn followed(&self, pieces: &[usize], is_own: bool) -> Measured {
        let last = pieces.len() - 1;
        let begin = (0..last + usize::from(is_own)).rev().find(|it| self.is_held(pieces[*it]));
        let way = &pieces[begin.unwrap_or(0)..];
        let (first, poses) = (&self.pieces[way[0]], &self.graph.poses);
        let covariance = begin.and(first.held).unwrap_or(first.step);
        let mut followed = Measured { motion: poses[way[0]], covariance };
        for pair in way.windows(2) {
            let motion = poses[pair[0]].inv_mul(&poses[pair[1]]);
            let step = Measured { motion, covariance: self.pieces[pair[1]].step };
            followed = followed.then(&step);
        }
        followed
    }

    /// Whether something else than steps holds a piece where the graph has it: one of its matches at least.
    fn is_held(&self, number: usize) -> bool {
        let piece = &self.pieces[number];
        let holds = |edge: &Edge| edge.distance(&self.graph.poses) <= PLAUSIBLE;
        piece.held.is_some() && (piece.is_seen || self.matches[number].iter().any(holds))
    }

    /// Number of matches with other robots' pieces, or with those from before a piece was last held: what the robot has
    /// seen since then is off as it is itself.
    pub(super) fn support(&self, number: usize, found: &Matches) -> usize {
        let robot = self.pieces[number].robot;
        let pieces = &self.robots[&robot].pieces;
        let end = pieces.partition_point(|it| *it < number);
        let held = pieces[..end].iter().rev().find(|it| self.is_held(**it));
        let is_older = |it: usize| held.is_some_and(|held| it <= *held);
        let counts = |edge: &&Edge| self.pieces[edge.from].robot != robot || is_older(edge.from);
        found.edges.iter().filter(counts).count()
    }

    /// With which covariance in the map a match with another piece puts one, if that is where it may be.
    pub(super) fn plausible(
        &self,
        (number, predicted): (usize, &Measured),
        other: usize,
        refined: &Refined,
    ) -> Option<Matrix3<f64>> {
        let poses = &self.graph.poses;
        let off = difference(&poses[other].inv_mul(&poses[number]), &refined.motion);
        let other = self.believed(other);
        let sum = other.inverse().then(predicted).covariance + refined.covariance;
        (off.dot(&(sum.try_inverse()? * off)) <= PLAUSIBLE).then(|| {
            let covariance = refined.covariance + covariance(LEFT);
            other.then(&Measured { motion: refined.motion, covariance }).covariance
        })
    }
}
