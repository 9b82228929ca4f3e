//! The uncertainty of a piece's pose, and the gate for its matches.
//!
//! The marginal covariances of the whole graph cost too much. Instead the covariance is propagated along the robot's
//! trajectory, from the last piece that cameras or matches hold in place.

use nalgebra::Matrix3;

use super::{
    Trajectories,
    matches::{Matches, covariance},
};
use crate::mapping::submaps::{Edge, Measured, Refined, difference};

/// Squared Mahalanobis distance beyond which a match contradicts where the pieces are: chi-squared with three degrees of
/// freedom at 99 %.
const PLAUSIBLE: f64 = 11.3;
/// Minimum deviations (metres, radians) of a matched pose: the error of the other piece's own drawing.
const LEFT: [f64; 3] = [0.03, 0.03, 0.01];

impl Trajectories {
    /// The pose of a piece in the graph. Its covariance in the map is propagated from the last held piece before it.
    pub(super) fn predicted(&self, number: usize) -> Measured {
        let pieces = &self.robots[&self.pieces[number].robot].pieces;
        self.followed(&pieces[..=pieces.partition_point(|it| *it < number)], false)
    }

    /// The pose of a piece in the graph, with its own covariance in the map if it is held, else as [`Self::predicted`].
    pub(super) fn believed(&self, number: usize) -> Measured {
        let pieces = &self.robots[&self.pieces[number].robot].pieces;
        self.followed(&pieces[..=pieces.partition_point(|it| *it < number)], true)
    }

    /// Propagates the covariance to the last of a robot's pieces, from the newest held one, or from the first.
    /// `is_own`: whether the last piece itself may be the held one.
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

    /// Whether cameras, or a match that agrees with the graph, hold a piece in place.
    fn is_held(&self, number: usize) -> bool {
        let piece = &self.pieces[number];
        let holds = |edge: &Edge| edge.distance(&self.graph.poses) <= PLAUSIBLE;
        piece.held.is_some() && (piece.is_seen || self.matches[number].iter().any(holds))
    }

    /// Number of independent matches: with other robots' pieces, or with pieces up to the last held one. Newer pieces of
    /// the robot share its drift.
    pub(super) fn support(&self, number: usize, found: &Matches) -> usize {
        let robot = self.pieces[number].robot;
        let pieces = &self.robots[&robot].pieces;
        let end = pieces.partition_point(|it| *it < number);
        let held = pieces[..end].iter().rev().find(|it| self.is_held(**it));
        let is_older = |it: usize| held.is_some_and(|held| it <= *held);
        let counts = |edge: &&Edge| self.pieces[edge.from].robot != robot || is_older(edge.from);
        found.edges.iter().filter(counts).count()
    }

    /// The covariance in the map that a match gives a piece. `None` if the match fails the gate.
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
