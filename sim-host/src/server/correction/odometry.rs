//! What a robot's reported poses tell of its odometry: how it moved from one to the next, and by how much it
//! misjudges turns.

use nalgebra::UnitComplex;
use ubimap_agent::locate::OdometryNoise;
use ubimap_protocol::units::{Angle, Millimetres, Pose};

use crate::mapping::{
    Match,
    submaps::{Motion, motion},
};

/// Squared Mahalanobis distance beyond which robots reject a fix: one good fix in a thousand.
pub(super) const GATE: f64 = 16.27;
/// Variance of a motion that wheels do not notice, from one report to the next: 3 mm and 0.1 degrees.
const PUSHED: Variances = Variances::of(3.0, 0.001_75);
/// A fix farther away than this, in metres or radians, moves the robot's pose by a jump if it is taken.
const JUMP: f64 = 0.3;
/// Deviation of the scale of a robot's turns before anything is known.
const SCALE: f64 = 0.01;
/// By how much (deviation) that scale may change while cameras see the robot, which then learns itself.
const RELEARNT: f64 = 0.002;

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

    /// Corrects a pose by another estimate of it, whose deviations of x, y (mm) and heading (rad) are given.
    /// `None` if the two are farther apart than their variances allow.
    pub(super) fn correct(&mut self, pose: Pose, seen: Pose, deviations: [f64; 3]) -> Option<Pose> {
        let off = [
            f64::from((seen.x - pose.x).0),
            f64::from((seen.y - pose.y).0),
            (seen.heading - pose.heading).radians(),
        ];
        let own = [self.place, self.place, self.turn];
        let sums: [f64; 3] =
            core::array::from_fn(|axis| own[axis] + deviations[axis] * deviations[axis]);
        if (0..3).map(|axis| off[axis] * off[axis] / sums[axis]).sum::<f64>() > GATE {
            return None;
        }
        let [x, y, turn]: [f64; 3] = core::array::from_fn(|axis| own[axis] / sums[axis]);
        self.place *= 1.0 - 0.5 * (x + y);
        self.turn *= 1.0 - turn;
        let part = |off: f64, gain: f64| Millimetres((gain * off).round() as i32);
        Some(Pose {
            x: pose.x + part(off[0], x),
            y: pose.y + part(off[1], y),
            heading: pose.heading + Angle::from_radians(turn * off[2]),
        })
    }
}

/// What a robot makes of the fixes that it gets for its reported poses. The next pose that it reports contains
/// the correction, which is no motion.
#[derive(Debug)]
pub(super) struct Reported {
    /// The last reported pose, corrected as the robot does by now.
    pose: Pose,
    /// The fix for it.
    fix: Option<Pose>,
    /// As the robot estimates them.
    variances: Variances,
}

impl Reported {
    /// A robot that was just seen at its pose.
    pub(super) fn seen_at(pose: Pose) -> Self {
        Self { pose, fix: None, variances: Variances::of(20.0, 0.009) }
    }

    /// A robot that did not know where it was, and takes this fix.
    pub(super) fn found_by(fix: &Match) -> Self {
        let [x, y, turn] = fix.deviations();
        Self { pose: fix.pose, fix: None, variances: Variances::of(x.max(y), turn) }
    }

    /// How the robot has moved by its odometry when it reports its next pose.
    pub(super) fn rolled_to(&mut self, pose: Pose) -> Motion {
        let size = |it: &Motion| it.translation.vector.norm() + it.rotation.angle().abs();
        let moved_from = |from: Pose| motion(from).inverse() * motion(pose);
        let mut rolled = moved_from(self.pose);
        // A robot that was far off may have rejected the fix, or given in to the last few.
        if let Some(fix) = self.fix {
            let is_far = size(&(motion(fix).inverse() * motion(self.pose))) > JUMP;
            let jumped = moved_from(fix);
            if is_far && size(&jumped) < size(&rolled) {
                rolled = jumped;
            }
        }
        (self.pose, self.fix) = (pose, None);
        self.variances = self.variances.plus(Variances::of_motion(&rolled)).plus(PUSHED);
        rolled
    }

    /// Notes the fix that the robot gets for the pose that it reported last.
    pub(super) fn fix(&mut self, fix: &Match) {
        self.fix = Some(fix.pose);
        let corrected = self.variances.correct(self.pose, fix.pose, fix.deviations());
        self.pose = corrected.unwrap_or(self.pose);
    }
}

/// The scale error of a robot's turns: what its own calibration has left, or made. Robots learn theirs where
/// cameras see them; a few turns there leave a per cent, which is four degrees in each look around.
#[derive(Clone, Copy, Debug)]
pub(super) struct TurnScale {
    /// 0.01 if the robot reports turns as one per cent too large.
    value: f64,
    variance: f64,
}

impl Default for TurnScale {
    fn default() -> Self {
        Self { value: 0.0, variance: SCALE * SCALE }
    }
}

impl TurnScale {
    /// The true motion, for one that the robot's odometry says.
    pub(super) fn corrected(&self, rolled: &Motion) -> Motion {
        let turn = rolled.rotation.angle();
        let off = -self.value * turn;
        // The heading goes wrong little by little on the way.
        let way = UnitComplex::new(0.5 * off) * rolled.translation.vector;
        Motion::new(way, turn + off)
    }

    /// Learns from a turn (rad) after which the predicted heading was `off` (rad), known with this variance.
    /// Outliers, from a wrong match or a push, are ignored.
    pub(super) fn learn(&mut self, turn: f64, off: f64, variance: f64) {
        let sum = self.variance * turn * turn + variance;
        if off * off > 9.0 * sum {
            return;
        }
        let gain = self.variance * turn / sum;
        self.value += gain * off;
        self.variance *= 1.0 - gain * turn;
    }

    /// The robot was in view, and may have learnt a little more.
    pub(super) fn doubt(&mut self) {
        self.variance = (self.variance + RELEARNT * RELEARNT).min(SCALE * SCALE);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use ubimap_agent::locate::{Located, Locator, PoseSource, UncertaintyLimit};
    use ubimap_protocol::{message::Certainty, time::Instant};

    use super::*;

    fn fix(pose: Pose) -> (Match, Certainty) {
        let [x, y, heading] = [30.0f64, 40.0, 0.01];
        let covariance =
            Matrix3::from_diagonal(&nalgebra::Vector3::new(x * x, y * y, heading * heading));
        let heading = Angle::from_radians(heading).0;
        (Match { pose, covariance }, Certainty { x: 30, y: 40, heading })
    }

    /// A robot, the real one's locator, drives on an arc and gets a fix each second. Between its reported poses
    /// it turns by what its odometry says.
    #[test]
    fn the_motion_between_reports_is_that_of_the_odometry() {
        let at = |second: f64| {
            let turn = 0.3 * second;
            Pose::from_metres(turn.sin(), 1.0 - turn.cos(), turn)
        };
        let limit = UncertaintyLimit::default();
        let mut locator = Locator::new(PoseSource::Fixes, &OdometryNoise::default(), limit);
        let mut reported = Reported::seen_at(at(0.0));
        let (mut worst, mut naive) = (0.0f64, 0.0f64);
        let mut last = at(0.0);
        for second in 0..40u32 {
            for tick in 0..20 {
                let moment = Instant(1_000_000 * u64::from(second + 10) + 50_000 * tick);
                locator.odometry(moment, at(f64::from(second) + 0.05 * tick as f64)).unwrap();
            }
            let moment = Instant(1_000_000 * u64::from(second + 10));
            let take = |locator: &mut Locator, pose, certainty| {
                let now = Instant(moment.0 + 900_000);
                locator.fix(moment, Some(moment), pose, certainty, now).unwrap()
            };
            if second == 0 {
                take(&mut locator, at(0.0), Certainty { x: 20, y: 20, heading: 94 });
                continue;
            }
            let Located::At(pose, _) = locator.at(moment, Instant(moment.0 + 900_000), true) else {
                panic!("{second}")
            };
            let rolled = reported.rolled_to(pose);
            worst = worst.max((rolled.rotation.angle() - 0.3).abs().to_degrees());
            naive = naive.max(((pose.heading - last.heading).radians() - 0.3).abs().to_degrees());
            last = pose;
            // The walls of every five metres were drawn by another robot.
            let side = if second / 5 % 2 == 0 { 1.0 } else { -1.0 };
            let map = motion(at(f64::from(second)));
            let seen = Pose::from_metres(
                map.translation.x + 0.02 * side,
                map.translation.y,
                map.rotation.angle() + 0.8f64.to_radians() * side,
            );
            let (found, certainty) = fix(seen);
            take(&mut locator, seen, certainty);
            reported.fix(&found);
        }
        println!("{worst:.2} degrees off, {naive:.2} with the fixes");
        assert!(worst < 0.15 && naive > 0.4, "{worst} {naive}");
    }

    #[test]
    fn a_robot_that_gives_in_to_its_fixes_has_not_moved() {
        let (told, there) = (Pose::from_metres(1.0, 1.0, 0.0), Pose::from_metres(2.0, 1.0, 0.5));
        let mut reported = Reported::seen_at(told);
        for _ in 0..3 {
            reported.fix(&fix(there).0);
            let stood = reported.rolled_to(told);
            assert!(stood.translation.vector.norm() + stood.rotation.angle().abs() < 1e-3);
        }
        reported.fix(&fix(there).0);
        let moved = reported.rolled_to(Pose::from_metres(2.1, 1.0, 0.5));
        assert!((moved.translation.vector.norm() - 0.1).abs() < 1e-3, "{moved}");
    }

    #[test]
    fn the_scale_of_turns_is_learnt_from_noisy_turns_to_both_sides() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut scale = TurnScale::default();
        let noise = 0.5f64.to_radians();
        for lesson in 0..200 {
            let turn = rng.random_range(-1.0..1.0);
            let said = 1.015 * turn + rng.random_range(-1.7..1.7) * noise;
            let predicted = scale.corrected(&Motion::new(nalgebra::Vector2::zeros(), said));
            // Each tenth view is matched wrongly.
            let wrong = if lesson % 10 == 0 { 0.2 } else { 0.0 };
            scale.learn(said, predicted.rotation.angle() - turn + wrong, noise * noise);
        }
        assert!((scale.value - 0.015).abs() < 0.003, "{scale:?}");
        let sure = scale.variance;
        scale.doubt();
        assert!(scale.variance > sure && scale.variance <= SCALE * SCALE);
    }
}
