//! What a robot tells of its odometry: how it moved from one view to the next, and its systematic errors: of distances, of
//! turns, and of the heading on straight ways.

use nalgebra::UnitComplex;
use ubimap_agent::locate::OdometryNoise;
use ubimap_protocol::{
    message::DistanceVector,
    time::Instant,
    units::{Angle, Millimetres, Pose},
};

use crate::mapping::{
    Match,
    submaps::{Motion, motion},
};

/// Squared Mahalanobis distance within which a pose may be corrected: three deviations.
const CORRECTABLE: f64 = 9.0;
/// Deviation of a scale of a robot's odometry before anything is known, and of its heading's drift in rad/m.
const SCALE: f64 = 0.01;
const BEND: f64 = 0.01;
/// By what part of that (deviation) such an error may change while cameras see the robot, which then learns itself.
const RELEARNT: f64 = 0.2;
/// A robot is assumed not to drive farther between two vectors than this distance (m), and this (m/s) times the time that
/// has passed.
const JUMP: f64 = 0.3;
const FASTEST: f64 = 2.0;

/// Variances of a pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Variances {
    /// Of x and of y, in mm^2.
    pub(super) place: f64,
    /// Of the heading, in rad^2.
    pub(super) turn: f64,
}

impl Variances {
    /// From standard deviations in millimetres and radians.
    pub(super) const fn of(place: f64, turn: f64) -> Self {
        Self { place: place * place, turn: turn * turn }
    }

    /// By how much odometry strays during a motion, by the noise that robots assume.
    pub(super) fn of_motion(rolled: &Motion) -> Self {
        let noise = OdometryNoise::default();
        let (way, turn) = (rolled.translation.vector.norm(), rolled.rotation.angle().abs());
        let square = |deviation: f64| deviation * deviation;
        Self {
            place: square(noise.position_per_metre.0.into()) * way,
            turn: square(noise.heading_per_metre.radians()) * way
                + square(noise.heading_per_radian.radians()) * turn,
        }
    }

    pub(super) fn plus(self, more: Self) -> Self {
        Self { place: self.place + more.place, turn: self.turn + more.turn }
    }

    /// The standard deviations.
    pub(super) fn deviations(self) -> (Millimetres, Angle) {
        (Millimetres(self.place.sqrt() as i32), Angle::from_radians(self.turn.sqrt().min(1.0)))
    }

    /// Whether another pose than the estimated one is plausible: at most three deviations away.
    pub(super) fn allow(self, pose: Pose, other: Pose) -> bool {
        let [x, y, turn] = off(pose, other);
        (x * x + y * y) / self.place + turn * turn / self.turn <= CORRECTABLE
    }
}

/// By how much a pose differs from another: in mm along x and y, and in rad.
pub(super) fn off(pose: Pose, other: Pose) -> [f64; 3] {
    let [x, y] = [other.x - pose.x, other.y - pose.y].map(|it| f64::from(it.0));
    [x, y, (other.heading - pose.heading).radians()]
}

/// Where a robot was by its own account when it sent a distance vector.
#[derive(Clone, Copy, Debug)]
pub(super) struct Reported {
    /// In `map`: it contains the fixes that the robot has taken.
    pub(super) pose: Pose,
    /// In `odom`, and when.
    odometry: Option<(Instant, Pose)>,
}

impl Reported {
    pub(super) fn by(vector: &DistanceVector) -> Self {
        Self { pose: vector.pose, odometry: vector.odometry.map(|pose| (vector.time, pose)) }
    }

    /// A robot that has told nothing since it was at this pose.
    pub(super) fn at(pose: Pose) -> Self {
        Self { pose, odometry: None }
    }

    /// With a fix for the pose. A robot without odometry goes on from it.
    pub(super) fn found(self, fix: &Match) -> Self {
        Self { pose: fix.pose, ..self }
    }

    /// How the robot has moved until it sent another vector.
    pub(super) fn rolled_to(&self, next: &Self) -> Motion {
        let between = |from, to| motion(from).inv_mul(&motion(to));
        let odometry = self.odometry.zip(next.odometry).and_then(|((then, from), (now, to))| {
            let rolled = between(from, to);
            let seconds = now.since(then).micros() as f64 / 1e6;
            // Odometry that has begun anew is no motion.
            (rolled.translation.vector.norm() <= JUMP + FASTEST * seconds).then_some(rolled)
        });
        odometry.unwrap_or_else(|| between(self.pose, next.pose))
    }
}

/// The systematic errors of a robot's odometry: what its own calibration has left, or made. Robots learn theirs where
/// cameras see them; the little that they drive there leaves a per cent, which is four degrees in each look around, and a
/// quarter of a metre in a long corridor.
#[derive(Clone, Copy, Debug)]
pub(super) struct SystematicErrors {
    /// 0.01 if the robot reports one per cent too much of distances (in m).
    pub(super) ways: RateError,
    /// The same of turns (in rad).
    pub(super) turns: RateError,
    /// Radians per metre straight ahead by which it reports too much: wheels of unequal size.
    pub(super) bends: RateError,
}

impl Default for SystematicErrors {
    fn default() -> Self {
        let [ways, turns, bends] = [SCALE, SCALE, BEND].map(RateError::unknown);
        Self { ways, turns, bends }
    }
}

impl SystematicErrors {
    /// The true motion, for one that the robot's odometry says.
    pub(super) fn corrected(&self, rolled: &Motion) -> Motion {
        let turn = rolled.rotation.angle();
        let off = -self.turns.value * turn - self.bends.value * rolled.translation.x;
        // The heading goes wrong little by little on the way.
        let way = UnitComplex::new(0.5 * off) * rolled.translation.vector;
        Motion::new((1.0 - self.ways.value) * way, turn + off)
    }

    /// Learns from a motion that the odometry said: `off` is its turn, as it was corrected, minus the true one, and
    /// `variance` is that of `off`.
    pub(super) fn learn_turn(&mut self, rolled: &Motion, off: f64, variance: f64) {
        let (way, turn) = (rolled.translation.x, rolled.rotation.angle());
        let [by_turn, by_bend] = [(&self.turns, turn), (&self.bends, way)]
            .map(|(error, amount)| error.variance * amount * amount);
        self.turns.learn(turn, off, variance + by_bend);
        self.bends.learn(way, off, variance + by_turn);
    }

    /// The robot was in view, and may have learnt a little more.
    pub(super) fn doubt(&mut self) {
        for error in [&mut self.ways, &mut self.turns, &mut self.bends] {
            error.doubt();
        }
    }
}

/// An error in proportion to a motion, which is being learnt, with its variance.
#[derive(Clone, Copy, Debug)]
pub(super) struct RateError {
    value: f64,
    variance: f64,
    /// The variance before anything is known.
    unknown: f64,
}

impl RateError {
    fn unknown(deviation: f64) -> Self {
        let unknown = deviation * deviation;
        Self { value: 0.0, variance: unknown, unknown }
    }

    /// Learns from a reported `amount`, for which, as it was corrected, too much was reported by `off`; this is known with
    /// this variance. Outliers, from a wrong match or a push, are ignored.
    pub(super) fn learn(&mut self, amount: f64, off: f64, variance: f64) {
        let sum = self.variance * amount * amount + variance;
        if off * off > 9.0 * sum {
            return;
        }
        let gain = self.variance * amount / sum;
        self.value += gain * off;
        self.variance *= 1.0 - gain * amount;
    }

    fn doubt(&mut self) {
        self.variance = (self.variance + RELEARNT * RELEARNT * self.unknown).min(self.unknown);
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn a_fix_that_a_robot_has_taken_is_no_motion() {
        let at = |x: f64, y: f64, degrees: f64| Pose::from_metres(x, y, degrees.to_radians());
        let odometry = |micros, y, degrees| Some((Instant(micros), at(-3.0, y, degrees)));
        let before = Reported { pose: at(1.0, 1.0, 0.0), odometry: odometry(0, 0.0, 90.0) };
        let after = Reported { pose: at(2.0, 1.0, 20.0), odometry: odometry(250_000, 0.5, 95.0) };
        let near = |it: Motion, x: f64, degrees: f64| {
            assert!((it.translation.vector - nalgebra::Vector2::new(x, 0.0)).norm() < 2e-3, "{it}");
            assert!((it.rotation.angle().to_degrees() - degrees).abs() < 0.02, "{it}");
        };
        near(before.rolled_to(&after), 0.5, 5.0);
        let fix = Match { pose: after.pose, covariance: nalgebra::Matrix3::identity() };
        near(before.found(&fix).rolled_to(&after), 0.5, 5.0);
        let without = Reported { odometry: None, ..before };
        near(without.found(&fix).rolled_to(&after), 0.0, 0.0);
        near(Reported { odometry: None, ..before }.rolled_to(&after), 1.0, 20.0);
        near(before.rolled_to(&Reported { odometry: None, ..after }), 1.0, 20.0);
        // It has begun anew; but half a second later it could be there.
        let (soon, later) = (odometry(250_000, 1.2, 95.0), odometry(750_000, 1.2, 95.0));
        near(before.rolled_to(&Reported { odometry: soon, ..after }), 1.0, 20.0);
        near(before.rolled_to(&Reported { odometry: later, ..after }), 1.2, 5.0);
    }

    #[test]
    fn a_match_may_not_correct_odometry_by_more_than_it_errs() {
        let at = |x: f64, degrees: f64| Pose::from_metres(x, 0.0, degrees.to_radians());
        let strayed = Variances::of(20.0, 1.0f64.to_radians());
        for (corrected, is_allowed) in [
            (at(0.0, 2.9), true),
            (at(0.0, 3.1), false),
            (at(0.0, -3.1), false),
            (at(0.059, 0.0), true),
            (at(-0.061, 0.0), false),
            (at(0.05, 2.0), false),
        ] {
            assert_eq!(strayed.allow(at(0.0, 0.0), corrected), is_allowed, "{corrected:?}");
        }
    }

    #[test]
    fn systematic_errors_are_learnt_from_noisy_motions_ahead_and_to_both_sides() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut systematic = SystematicErrors::default();
        let (noise, noise_m) = (0.5f64.to_radians(), 0.008);
        for lesson in 0..200 {
            let (way, turn) = (rng.random_range(0.0..0.5), rng.random_range(-1.0..1.0));
            let mut said = |true_one: f64, scale: f64, noise: f64| {
                scale * true_one + rng.random_range(-1.7..1.7) * noise
            };
            let (said, turned) = (said(way, 0.99, noise_m), said(turn, 1.015, noise) - 0.012 * way);
            let along = |way: f64| nalgebra::Vector2::new(way, 0.0);
            let ahead = systematic.corrected(&Motion::new(along(said), 0.0)).translation.vector.x;
            let rolled = Motion::new(along(said), turned);
            let predicted = systematic.corrected(&rolled);
            // Each tenth view is matched wrongly.
            let wrong = if lesson % 10 == 0 { 0.2 } else { 0.0 };
            systematic.ways.learn(said, ahead - way + wrong, noise_m * noise_m);
            systematic.learn_turn(
                &rolled,
                predicted.rotation.angle() - turn + wrong,
                noise * noise,
            );
        }
        let SystematicErrors { ways, turns, bends } = systematic;
        assert!((ways.value + 0.01).abs() < 0.004, "{systematic:?}");
        assert!((turns.value - 0.015).abs() < 0.003, "{systematic:?}");
        assert!((bends.value + 0.012).abs() < 0.003, "{systematic:?}");
        systematic.doubt();
        let doubted = [systematic.ways, systematic.turns, systematic.bends];
        for (sure, doubted) in [ways, turns, bends].into_iter().zip(doubted) {
            assert!(doubted.variance > sure.variance && doubted.variance <= doubted.unknown);
        }
    }
}
