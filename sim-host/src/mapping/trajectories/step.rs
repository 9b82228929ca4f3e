//! How a robot moves from view to view.

use crate::mapping::submaps::Motion;

/// A robot that was followed with a heading better than this, in radians, was not lost on the way.
const SURE: f64 = 0.02;
/// What robots assume of their odometry, and what a match says of itself, is three times as much as they are off from
/// one view to the next.
const CAUTION: f64 = 0.32;

/// How a robot has moved since its last view.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    /// The motion.
    pub(super) by: Motion,
    /// Deviations of its x, y and turn.
    pub(super) deviations: [f64; 3],
    /// Whether it may be wrong by far.
    pub(super) is_doubted: bool,
}

impl Step {
    /// A motion that odometry knows with these deviations in each direction and in the turn.
    /// `followed` are those of x, y and turn with which the robot was followed by what it saw, if
    /// it was.
    pub fn new(by: Motion, [place, turn]: [f64; 2], followed: Option<[f64; 3]>) -> Self {
        let [x, y, seen] = followed.unwrap_or([f64::INFINITY; 3]);
        let both = |one: f64, other: f64| (one.powi(-2) + other.powi(-2)).powf(-0.5);
        let known = |rolled: f64, seen: f64, least: f64| CAUTION * both(rolled, seen) + least;
        let deviations =
            [known(place, x, 0.002_5), known(place, y, 0.002_5), known(turn, seen, 0.001)];
        Self { by, deviations, is_doubted: seen > SURE }
    }

    /// The motion between two poses that a robot reported, if nothing else is known about it.
    pub(super) fn reported(from: &Motion, to: &Motion) -> Self {
        let by = from.inv_mul(to);
        let (way, turn) = (by.translation.vector.norm(), by.rotation.angle().abs());
        let place = 0.006_5 + 0.016 * way;
        let deviations = [place, place, 0.003 + 0.01 * (way + turn)];
        Self { by, deviations, is_doubted: true }
    }

    /// A motion about which nothing is known.
    pub(super) fn unknown(by: Motion) -> Self {
        Self { by, deviations: [5.0, 5.0, 3.0], is_doubted: true }
    }

    /// This motion and then another.
    pub(super) fn then(&self, next: &Self) -> Self {
        let sum = |axis: usize| self.deviations[axis].hypot(next.deviations[axis]);
        let is_doubted = self.is_doubted || next.is_doubted;
        Self { by: self.by * next.by, deviations: [sum(0), sum(1), sum(2)], is_doubted }
    }
}
