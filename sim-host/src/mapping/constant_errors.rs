//! Separates two constant errors of a robot. If the heading seen by cameras differs from the course
//! over ground, the identifier (the marker that cameras see) is mounted askew. If the robot's
//! distance vectors are then still rotated relative to the map, its sensor is mounted askew.

use std::collections::VecDeque;

use core::f64::consts::{FRAC_PI_2, PI};

use libm::atan2;
use ubimap_protocol::{
    tile::Epoch,
    time::{Duration, Instant},
    units::{Angle, Pose, RobotId},
};

use crate::timing::FIX_GAP;

/// Length of a stretch after which its course is measured, in metres. The measurement is repeated
/// at each multiple.
const STRETCH_M: f64 = 0.6;
/// Maximum duration of a stretch.
const STRETCH_TIME: Duration = Duration::from_secs(8);
/// Minimum number of fixes for a stretch to count as straight.
const MIN_FIXES: usize = 6;
/// A turn by more than this, in degrees, ends a stretch. It exceeds the noise of fixes.
const TURN_DEG: f64 = 5.0;
/// Maximum difference between the mean headings of a stretch's two halves, in degrees.
const BEND_DEG: f64 = 1.5;
/// Maximum difference between heading and course, in degrees. No identifier is mounted further
/// askew, so a larger difference means that the robot moves sideways.
const MAX_DEG: f64 = 15.0;
/// Standard deviation of the error that all fixes along one `STRETCH_M` share, in degrees: the
/// accuracy of the cameras' calibration.
const STRETCH_DEVIATION_DEG: f64 = 0.25;
/// Maximum number of measurements that are kept; the oldest is dropped.
const MAX_MEASUREMENTS: usize = 30;
/// Minimum number of measurements for an estimate.
const MIN_MEASUREMENTS: usize = 3;
/// Minimum error that is corrected, in degrees.
const MIN_CURE_DEG: f64 = 0.4;
/// Minimum error that is corrected, in standard deviations.
const CURE_DEVIATIONS: f64 = 3.0;
/// Maximum standard deviation for a correction, in degrees: the error is then known to half a
/// degree.
const SURE_DEG: f64 = 0.5 / CURE_DEVIATIONS;
/// Distance from the mean, in standard deviations, beyond which Tukey's biweight ignores a
/// measurement. With this value it is 95 % efficient for normally distributed measurements.
const BIWEIGHT: f64 = 4.685;
/// Number of iterations of the biweight.
const ROUNDS: usize = 10;
/// Ratio of the standard deviation to the median absolute deviation of a normal distribution.
const NORMAL: f64 = 1.4826;

/// An estimated angle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimated {
    /// The angle in degrees, counter-clockwise.
    pub degrees: f64,
    /// Standard deviation in degrees.
    pub deviation: f64,
}

impl Estimated {
    fn is_worth_a_cure(&self) -> bool {
        self.deviation <= SURE_DEG
            && self.degrees.abs() > MIN_CURE_DEG.max(CURE_DEVIATIONS * self.deviation)
    }
}

/// The corrections applied for a robot's constant errors.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cured {
    /// The identifier's error in degrees, which is subtracted from fixes.
    pub taken_out: f64,
    /// The angle in degrees that the robot adds to its sensor's heading.
    pub added: f64,
}

/// Progress of correcting a robot's errors (its cure), as stored on disk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CureRecord {
    /// The robot.
    pub robot: RobotId,
    /// The corrections that are applied.
    pub cured: Cured,
    /// The robot's tiles of epochs below this one are void.
    pub first_epoch: Epoch,
    /// Whether the cure is complete; if not, everything drawn up to now will become void, too.
    pub is_over: bool,
}

/// Estimates of one robot's constant errors.
#[derive(Clone, Debug, Default)]
pub struct ConstantErrors {
    stretch: Stretch,
    /// For each completed stretch, heading minus course, and the standard deviation of this
    /// difference, in degrees.
    askew: VecDeque<(f64, f64)>,
    /// For each distance vector, its rotation relative to the map, measured from the uncorrected
    /// heading that cameras see, and the standard deviation, both in degrees.
    turned: VecDeque<(f64, f64)>,
    /// Estimates from `askew` (with the current stretch) and from `turned`, updated with each
    /// measurement.
    identifier: Option<Estimated>,
    turn: Option<Estimated>,
    cured: Cured,
}

impl ConstantErrors {
    /// Adds a camera fix, `seen` at `moment`, to the estimate if it is newer than the previous one.
    /// Returns it with the identifier's error subtracted.
    pub fn fix(&mut self, moment: Instant, seen: Pose) -> Pose {
        let before = self.stretch.measured;
        if let Some(measured) = self.stretch.go(moment, seen) {
            push(&mut self.askew, measured);
        }
        if self.stretch.measured != before {
            let measured = self.askew.iter().chain(&self.stretch.measured);
            self.identifier = estimate(measured.copied().collect());
        }
        self.corrected(seen)
    }

    /// The pose `seen` by cameras, with the identifier's error subtracted.
    pub fn corrected(&self, seen: Pose) -> Pose {
        Pose { heading: seen.heading - Angle::from_degrees(self.cured.taken_out), ..seen }
    }

    /// Adds the rotation of a distance vector relative to the map, measured from a corrected pose,
    /// and its standard deviation, both in degrees.
    pub fn turned(&mut self, degrees: f64, deviation: f64) {
        push(&mut self.turned, (degrees - self.cured.taken_out, deviation));
        self.turn = estimate(self.turned.iter().copied().collect());
    }

    /// Estimated error of the identifier's mounting.
    pub fn identifier(&self) -> Option<Estimated> {
        self.identifier
    }

    /// Estimated error of the sensor's mounting, relative to the robot's calibration.
    pub fn sensor(&self) -> Option<Estimated> {
        let (turn, identifier) = (self.turn?, self.identifier?);
        Some(Estimated {
            degrees: turn.degrees + identifier.degrees,
            deviation: turn.deviation.hypot(identifier.deviation),
        })
    }

    /// The corrections that are applied.
    pub fn cured(&self) -> Cured {
        self.cured
    }

    /// Starts without measurements, with the corrections that are already applied.
    pub fn of(cured: Cured) -> Self {
        Self { cured, ..Self::default() }
    }

    /// Starts to subtract the identifier's error from fixes, if the estimate is certain and differs
    /// enough from the current correction. Returns whether it did.
    pub fn cure_identifier(&mut self) -> bool {
        let Some(found) = self.identifier() else { return false };
        let left = Estimated { degrees: found.degrees - self.cured.taken_out, ..found };
        if left.is_worth_a_cure() {
            self.cured.taken_out = found.degrees;
        }
        left.is_worth_a_cure()
    }

    /// The angle to add to the sensor's mounting, if the estimate is certain and large enough. It
    /// depends on the identifier's error, so that must be corrected first.
    pub fn sensor_to_cure(&self) -> Option<Angle> {
        let found = self.sensor().filter(Estimated::is_worth_a_cure)?;
        Some(Angle::from_degrees(found.degrees))
    }

    /// Records that the robot has turned its sensor's mounting by this angle.
    pub fn remounted(&mut self, turn: Angle) {
        self.turned.clear();
        self.turn = None;
        self.cured.added += turn.degrees();
    }
}

fn push(measured: &mut VecDeque<(f64, f64)>, one: (f64, f64)) {
    if measured.len() == MAX_MEASUREMENTS {
        measured.pop_front();
    }
    measured.push_back(one);
}

/// Robust mean of pairs of a value and its standard deviation, by Tukey's biweight: in some places
/// an error of the map shifts every measurement by several deviations. `None` if fewer than
/// [`MIN_MEASUREMENTS`] remain, or if more than a third are outliers, since the majority is then
/// not reliable.
fn estimate(measured: Vec<(f64, f64)>) -> Option<Estimated> {
    let mut mean = median(measured.iter().map(|it| it.0).collect())?;
    let (mut shares, mut weights) = (Vec::new(), 0.0);
    for _ in 0..ROUNDS {
        let offs: Vec<f64> =
            measured.iter().map(|(degrees, deviation)| (degrees - mean) / deviation).collect();
        let scatter = NORMAL * median(offs.iter().map(|off| off.abs()).collect())?;
        let reach = BIWEIGHT * scatter.max(1.0);
        shares = offs.iter().map(|off| (1.0 - (off / reach).powi(2)).max(0.0).powi(2)).collect();
        let weighed = measured.iter().zip(&shares);
        let weighed = weighed.map(|((degrees, deviation), share): (_, &f64)| {
            (degrees, share / (deviation * deviation))
        });
        weights = weighed.clone().map(|(_, weight)| weight).sum();
        mean = weighed.map(|(degrees, weight)| degrees * weight).sum::<f64>() / weights;
    }
    let near = shares.iter().filter(|share| **share > 0.0).count();
    if near < MIN_MEASUREMENTS || 3 * near < 2 * measured.len() {
        return None;
    }
    let chi = |((degrees, deviation), share): (&(f64, f64), &f64)| {
        share * ((degrees - mean) / deviation).powi(2)
    };
    let chi: f64 = measured.iter().zip(&shares).map(chi).sum();
    let scatter = (chi / (shares.iter().sum::<f64>() - 1.0)).max(1.0);
    Some(Estimated { degrees: mean, deviation: (scatter / weights).sqrt() })
}

/// The median; `None` if empty.
fn median(mut all: Vec<f64>) -> Option<f64> {
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied()
}

/// Consecutive fixes of a robot that drives straight.
#[derive(Clone, Debug, Default)]
struct Stretch {
    fixes: Vec<(Instant, Pose)>,
    /// Heading minus course, and the standard deviation of this difference, in degrees, once the
    /// stretch is long enough. A stretch of twice the length is about three times as accurate.
    measured: Option<(f64, f64)>,
    /// Number of measurements of this stretch so far.
    parts: u32,
}

impl Stretch {
    /// Adds a fix, `seen` at `moment`. If the robot no longer drives straight, starts a new stretch
    /// and returns the measurement of the previous one.
    fn go(&mut self, moment: Instant, seen: Pose) -> Option<(f64, f64)> {
        let (first, last) = (self.fixes.first().copied(), self.fixes.last().copied());
        if last.is_some_and(|(last, _)| moment <= last) {
            return None;
        }
        let broken = first.zip(last).is_some_and(|((begun, first), (last, _))| {
            moment.since(last) > FIX_GAP
                || moment.since(begun) > STRETCH_TIME
                || (seen.heading - first.heading).degrees().abs() > TURN_DEG
        });
        let over = if broken { core::mem::take(self).measured } else { None };
        self.fixes.push((moment, seen));
        let [x, y] = way_m(self.fixes.first()?.1, seen);
        if x.hypot(y) < f64::from(self.parts + 1) * STRETCH_M {
            return over;
        }
        let measured = self.measure().filter(|(degrees, _)| degrees.abs() <= MAX_DEG);
        if measured.is_none() {
            return core::mem::take(self).measured;
        }
        (self.measured, self.parts) = (measured, self.parts + 1);
        None
    }

    fn measure(&self) -> Option<(f64, f64)> {
        if self.fixes.len() < MIN_FIXES {
            return None;
        }
        let (_, first) = *self.fixes.first()?;
        let (_, last) = *self.fixes.last()?;
        let count = self.fixes.len() as f64;
        let points: Vec<[f64; 2]> =
            self.fixes.iter().map(|(_, pose)| way_m(first, *pose)).collect();
        let mean = |axis: usize| points.iter().map(|point| point[axis]).sum::<f64>() / count;
        let (mean_x, mean_y) = (mean(0), mean(1));
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for [x, y] in &points {
            let (dx, dy) = (x - mean_x, y - mean_y);
            (xx, xy, yy) = (xx + dx * dx, xy + dx * dy, yy + dy * dy);
        }
        let spread = ((xx - yy) * (xx - yy) + 4.0 * xy * xy).sqrt();
        let (along, across) = ((xx + yy + spread) / 2.0, ((xx + yy - spread) / 2.0).max(0.0));
        let [x, y] = way_m(first, last);
        let mut course = 0.5 * atan2(2.0 * xy, xx - yy);
        // A line has two directions; this is the direction of travel.
        let forward = atan2(y, x) - course;
        if libm::cos(forward) < 0.0 {
            course += PI;
        }

        let turns: Vec<f64> =
            self.fixes.iter().map(|(_, pose)| (pose.heading - first.heading).degrees()).collect();
        let part_mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
        let (before, after) = turns.split_at_checked(turns.len() / 2)?;
        if before.is_empty() || (part_mean(before) - part_mean(after)).abs() > BEND_DEG {
            return None;
        }
        let turn = part_mean(&turns);
        let heading_variance =
            turns.iter().map(|it| (it - turn).powi(2)).sum::<f64>() / (count - 1.0) / count;
        let course_variance = (across / (count - 2.0).max(1.0) / along).sqrt().to_degrees().powi(2);

        let mut off =
            (first.heading + Angle::from_degrees(turn) - Angle::from_radians(course)).radians();
        // The robot drives backwards.
        if off.abs() > FRAC_PI_2 {
            off -= PI.copysign(off);
        }
        let common = STRETCH_DEVIATION_DEG.powi(2) * STRETCH_M / x.hypot(y);
        let variance = heading_variance + course_variance + common;
        Some((off.to_degrees(), variance.sqrt()))
    }
}

/// Displacement between two poses in metres.
fn way_m(from: Pose, to: Pose) -> [f64; 2] {
    [(to.x - from.x).metres(), (to.y - from.y).metres()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Fixes at 15 Hz of a robot that drives back and forth and turns at the ends, with its
    /// identifier askew; `noise` is added to each fix, in degrees for the heading and in units of 5
    /// mm for the position.
    fn drive(
        errors: &mut ConstantErrors,
        askew: f64,
        seconds: u64,
        mut noise: impl FnMut() -> f64,
    ) {
        for frame in 0..seconds * 15 {
            let time = frame as f64 / 15.0;
            let phase = time.rem_euclid(16.0);
            let (x, heading) = match phase {
                ..=6.0 => (phase * 0.4, 0.0),
                6.0..=8.0 => (2.4, (phase - 6.0) * 90.0),
                8.0..=14.0 => (2.4 - (phase - 8.0) * 0.4, 180.0),
                _ => (0.0, 180.0 + (phase - 14.0) * 90.0),
            };
            let (sin, cos) = 0.7f64.sin_cos();
            let seen = Pose::from_metres(
                x * cos + 0.005 * noise(),
                x * sin + 0.005 * noise(),
                0.7 + (heading + askew + noise()).to_radians(),
            );
            errors.fix(Instant((time * 1e6) as u64), seen);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(30))]

        #[test]
        fn an_askew_identifier_is_found_within_half_a_minute(
            askew in -10.0f64..10.0,
            throws in proptest::collection::vec(-1.7f64..1.7, 1_400),
        ) {
            let mut errors = ConstantErrors::default();
            let mut throw = throws.iter().cycle();
            drive(&mut errors, askew, 30, || *throw.next().unwrap());
            let found = errors.identifier().expect("after 10 m");
            let off = found.degrees - askew;
            prop_assert!(off.abs() < 0.5 && off.abs() < 4.0 * found.deviation, "{off} {found:?}");
            // A single correction suffices.
            prop_assert_eq!(errors.cure_identifier(), askew.abs() > 0.5 || errors.cured().taken_out != 0.0);
            prop_assert!(!errors.cure_identifier());
            let seen = Pose { heading: Angle::from_degrees(40.0 + askew), ..Pose::default() };
            if errors.cured().taken_out != 0.0 {
                prop_assert!((errors.corrected(seen).heading.degrees() - 40.0).abs() < 0.5);
            }
        }
    }

    #[test]
    fn identifier_and_sensor_errors_are_separated() {
        for (identifier, sensor) in [(3.0, 0.0), (0.0, 3.0), (3.0, -3.0), (2.0, 2.0), (0.2, 0.0)] {
            let mut errors = ConstantErrors::default();
            let vectors = |errors: &mut ConstantErrors| {
                for vector in 0..10 {
                    let noise = [0.3, -0.2, -0.1][vector % 3];
                    let turned = sensor - (identifier - errors.cured().taken_out) + noise;
                    errors.turned(turned, 0.4);
                }
            };
            vectors(&mut errors);
            // Neither error is known before the robot has driven.
            assert!(!errors.cure_identifier() && errors.sensor_to_cure().is_none());
            drive(&mut errors, identifier, 30, || 0.0);
            assert_eq!(errors.cure_identifier(), identifier > 1.0);
            let cured = errors.sensor_to_cure().map_or(0.0, Angle::degrees);
            assert!((cured - sensor).abs() < 0.2, "{identifier} {sensor}: {cured}");
            vectors(&mut errors);
            let again = errors.sensor_to_cure().map_or(0.0, Angle::degrees);
            assert!((again - cured).abs() < 0.1, "curing one does not change the other");
            errors.remounted(Angle::from_degrees(cured));
            assert_eq!(errors.sensor(), None);
        }
    }

    #[test]
    fn outliers_where_the_map_misleads_are_ignored() {
        let noise = [0.4, -0.3, 0.1, -0.2];
        let about =
            |middle: f64, count: usize| (0..count).map(move |it| (middle + noise[it % 4], 0.4));
        let usual = |count| about(3.0, count);
        let all = estimate(usual(20).chain(about(0.5, 5)).collect()).unwrap();
        assert!((all.degrees - 3.0).abs() < 0.05, "{all:?}");
        // With too many outliers there is no estimate.
        assert_eq!(estimate(usual(16).chain(about(-7.0, 14)).collect()), None);
        let halves = estimate(usual(15).chain(about(0.5, 15)).collect());
        assert!(halves.is_none_or(|it| !it.is_worth_a_cure()), "{halves:?}");
        assert_eq!(estimate(usual(2).collect()), None);
        // The deviation follows from the measurements' own deviations, or from their scatter if
        // that is larger.
        let apart = estimate(usual(16).collect()).unwrap().deviation;
        assert!((0.1..0.11).contains(&apart), "{apart}");
        let scattered = usual(16).map(|(degrees, _)| (3.0 + 10.0 * (degrees - 3.0), 0.4));
        let scattered = estimate(scattered.collect()).unwrap().deviation;
        assert!((0.6..1.0).contains(&scattered), "{scattered}");
    }

    #[test]
    fn a_longer_stretch_is_more_accurate_than_its_parts() {
        let mut throw = [1.0, -0.4, 0.7, -1.3, 0.2, -0.2].iter().cycle();
        let mut errors = ConstantErrors::default();
        let mut deviations = Vec::new();
        for frame in 0..90 {
            let (along, off) = (f64::from(frame) * 0.03, 0.01 * throw.next().unwrap());
            errors.fix(Instant(frame as u64 * 66_667), Pose::from_metres(along, off, 0.05));
            deviations.extend(errors.stretch.measured.map(|it| it.1));
        }
        deviations.dedup();
        let [first, second, .., last] = deviations[..] else { panic!("{deviations:?}") };
        assert!(second < 0.55 * first && last < 0.25 * first, "{deviations:?}");
        // It is still one stretch; its measurement is stored when it ends.
        assert_eq!(errors.askew, []);
        errors.fix(Instant(6_200_000), Pose::from_metres(2.7, 0.0, 1.0));
        assert_eq!(errors.askew.len(), 1);
        assert!((errors.askew[0].0 - 0.05f64.to_degrees()).abs() < 0.2);
    }

    #[test]
    fn a_robot_that_drives_backwards_or_sideways_has_no_askew_identifier() {
        for (way, expected) in [(180.0f64, Some(0.0)), (90.0, None)] {
            let mut errors = ConstantErrors::default();
            for frame in 0..300 {
                let along = f64::from(frame) * 0.03;
                let (sin, cos) = way.to_radians().sin_cos();
                let seen = Pose::from_metres(along * cos, along * sin, 0.0);
                errors.fix(Instant(frame as u64 * 66_667), seen);
            }
            assert_eq!(errors.identifier().map(|it| it.degrees.round()), expected);
        }
    }
}
