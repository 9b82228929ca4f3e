//! The two constant errors of a robot, told apart: an identifier glued on askew shows as a
//! difference between the heading that cameras see and the course over ground; what then still
//! turns the robot's distance vectors against the map is a sensor mounted askew.

use std::collections::VecDeque;

use core::f64::consts::{FRAC_PI_2, PI};

use libm::atan2;
use ubimap_protocol::{
    tile::Epoch,
    time::{Duration, Instant},
    units::{Angle, Pose, RobotId},
};

use crate::timing::FIX_GAP;

/// A stretch that is long enough for its course, in metres: it is measured then, and again whenever it
/// is so much longer. The longest time that it may take.
const STRETCH_M: f64 = 0.6;
const STRETCH_TIME: Duration = Duration::from_secs(8);
/// A stretch of fewer fixes may have been anything but straight.
const LEAST_FIXES: usize = 6;
/// A robot that turns by more than this ends its stretch, in degrees: beyond the noise of fixes.
const TURN_DEG: f64 = 5.0;
/// A stretch whose two halves head more differently than this was no straight one.
const BEND_DEG: f64 = 1.5;
/// Beyond this an identifier is not glued on askew, but the robot moves sideways.
const MOST_DEG: f64 = 15.0;
/// What the fixes on so much way have in common, in degrees: cameras are calibrated so well.
const STRETCH_DEVIATION_DEG: f64 = 0.25;
/// Measurements that count, the newest, and the least for an estimate.
const MOST: usize = 30;
const LEAST: usize = 3;
/// An error is cured when it is greater than this, in degrees, and so many deviations.
const LEAST_CURE_DEG: f64 = 0.4;
const CURE_DEVIATIONS: f64 = 3.0;
/// What is cured is known to half a degree: an estimate less sure is none.
const SURE_DEG: f64 = 0.5 / CURE_DEVIATIONS;
/// Measurements farther from the mean than so many deviations do not count: the biweight has 95 % of
/// the mean's efficiency on normal ones then. Rounds of it.
const BIWEIGHT: f64 = 4.685;
const ROUNDS: usize = 10;
/// The standard deviation of normal errors over the median of their absolute values.
const NORMAL: f64 = 1.4826;

/// An angle in degrees, and how sure it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimated {
    /// In degrees, counter-clockwise.
    pub degrees: f64,
    /// Its standard deviation, in degrees.
    pub deviation: f64,
}

impl Estimated {
    fn is_worth_a_cure(&self) -> bool {
        self.deviation <= SURE_DEG
            && self.degrees.abs() > LEAST_CURE_DEG.max(CURE_DEVIATIONS * self.deviation)
    }
}

/// What has been done about the constant errors of a robot.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cured {
    /// What is taken out of the fixes, in degrees.
    pub taken_out: f64,
    /// What the robot has been told to add to its sensor's heading, in degrees.
    pub added: f64,
}

/// How far the cure of a robot has come, to be kept on disk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CureRecord {
    /// Whose.
    pub robot: RobotId,
    /// What has been done about its errors.
    pub cured: Cured,
    /// Its tiles of epochs below this one are void.
    pub first_epoch: Epoch,
    /// Whether nothing is left to do: else all that it has drawn until now is to be void as well.
    pub is_over: bool,
}

/// The constant errors of one robot.
#[derive(Clone, Debug, Default)]
pub struct ConstantErrors {
    stretch: Stretch,
    /// Heading less course, of each stretch that is over: degrees and their standard deviation.
    askew: VecDeque<(f64, f64)>,
    /// How far the distance vectors are turned against the map from headings as the cameras see
    /// them, in degrees.
    turned: VecDeque<(f64, f64)>,
    /// What follows of the two, computed once for each measurement.
    identifier: Option<Estimated>,
    turn: Option<Estimated>,
    cured: Cured,
}

impl ConstantErrors {
    /// Takes where a camera saw the robot, in the order of the frames, and returns where it is.
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

    /// A pose without the identifier's error, as far as it is taken out.
    pub fn corrected(&self, seen: Pose) -> Pose {
        Pose { heading: seen.heading - Angle::from_degrees(self.cured.taken_out), ..seen }
    }

    /// Takes how far a distance vector was turned against the map, from a corrected pose, and how
    /// sure that is: degrees.
    pub fn turned(&mut self, degrees: f64, deviation: f64) {
        push(&mut self.turned, (degrees - self.cured.taken_out, deviation));
        self.turn = estimate(self.turned.iter().copied().collect());
    }

    /// How far the identifier is glued on askew.
    pub fn identifier(&self) -> Option<Estimated> {
        self.identifier
    }

    /// How far the sensor is mounted askew from what the robot believes.
    pub fn sensor(&self) -> Option<Estimated> {
        let (turn, identifier) = (self.turn?, self.identifier?);
        Some(Estimated {
            degrees: turn.degrees + identifier.degrees,
            deviation: turn.deviation.hypot(identifier.deviation),
        })
    }

    /// What has been done about them.
    pub fn cured(&self) -> Cured {
        self.cured
    }

    /// The errors of a robot of which no more is known than what was done about them.
    pub fn of(cured: Cured) -> Self {
        Self { cured, ..Self::default() }
    }

    /// Takes the identifier's error out of the fixes from now on, if it is sure and not taken out
    /// already. Whether it does.
    pub fn cure_identifier(&mut self) -> bool {
        let Some(found) = self.identifier() else { return false };
        let left = Estimated { degrees: found.degrees - self.cured.taken_out, ..found };
        if left.is_worth_a_cure() {
            self.cured.taken_out = found.degrees;
        }
        left.is_worth_a_cure()
    }

    /// The sensor's error if it is sure and worth a cure: the angle to add to the mounting that the
    /// robot believes in. It comes after the identifier's, on which it depends.
    pub fn sensor_to_cure(&self) -> Option<Angle> {
        let found = self.sensor().filter(Estimated::is_worth_a_cure)?;
        Some(Angle::from_degrees(found.degrees))
    }

    /// The robot believes its sensor turned by this much more from now on.
    pub fn remounted(&mut self, turn: Angle) {
        self.turned.clear();
        self.turn = None;
        self.cured.added += turn.degrees();
    }
}

fn push(measured: &mut VecDeque<(f64, f64)>, one: (f64, f64)) {
    if measured.len() == MOST {
        measured.pop_front();
    }
    measured.push_back(one);
}

/// The mean of measurements by Tukey's biweight: there are places where the map misleads by several
/// deviations whenever a robot comes by. `None` if a third of them lies far from the others, for nobody
/// knows who is right then.
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
    if near < LEAST || 3 * near < 2 * measured.len() {
        return None;
    }
    let chi = |((degrees, deviation), share): (&(f64, f64), &f64)| {
        share * ((degrees - mean) / deviation).powi(2)
    };
    let chi: f64 = measured.iter().zip(&shares).map(chi).sum();
    let scatter = (chi / (shares.iter().sum::<f64>() - 1.0)).max(1.0);
    Some(Estimated { degrees: mean, deviation: (scatter / weights).sqrt() })
}

/// The middle one, if there is any.
fn median(mut all: Vec<f64>) -> Option<f64> {
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied()
}

/// Fixes of a robot that drives straight on.
#[derive(Clone, Debug, Default)]
struct Stretch {
    fixes: Vec<(Instant, Pose)>,
    /// Heading less course, in degrees, and their standard deviation, once it is long enough. The
    /// course of a stretch of twice the length is known three times as well.
    measured: Option<(f64, f64)>,
    /// How often it was measured.
    parts: u32,
}

impl Stretch {
    /// The robot is seen somewhere. If it no longer drives straight on another stretch begins: what
    /// was measured on the one that is over.
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
        let measured = self.measure().filter(|(degrees, _)| degrees.abs() <= MOST_DEG);
        if measured.is_none() {
            return core::mem::take(self).measured;
        }
        (self.measured, self.parts) = (measured, self.parts + 1);
        None
    }

    fn measure(&self) -> Option<(f64, f64)> {
        if self.fixes.len() < LEAST_FIXES {
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
        // The line's direction that is the way's.
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
        // A robot that drives backwards.
        if off.abs() > FRAC_PI_2 {
            off -= PI.copysign(off);
        }
        let common = STRETCH_DEVIATION_DEG.powi(2) * STRETCH_M / x.hypot(y);
        let variance = heading_variance + course_variance + common;
        Some((off.to_degrees(), variance.sqrt()))
    }
}

/// From one pose to another, in metres.
fn way_m(from: Pose, to: Pose) -> [f64; 2] {
    [(to.x - from.x).metres(), (to.y - from.y).metres()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Fixes at 15 Hz of a robot that drives there and back and turns at the ends, its identifier
    /// turned by some degrees; `noise` is of each fix, in millimetres and degrees.
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
            // Cured once, and for good.
            prop_assert_eq!(errors.cure_identifier(), askew.abs() > 0.5 || errors.cured().taken_out != 0.0);
            prop_assert!(!errors.cure_identifier());
            let seen = Pose { heading: Angle::from_degrees(40.0 + askew), ..Pose::default() };
            if errors.cured().taken_out != 0.0 {
                prop_assert!((errors.corrected(seen).heading.degrees() - 40.0).abs() < 0.5);
            }
        }
    }

    #[test]
    fn the_two_are_told_apart_and_neither_takes_the_other_for_its_own() {
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
            // Before it has driven nothing is known of either.
            assert!(!errors.cure_identifier() && errors.sensor_to_cure().is_none());
            drive(&mut errors, identifier, 30, || 0.0);
            assert_eq!(errors.cure_identifier(), identifier > 1.0);
            let cured = errors.sensor_to_cure().map_or(0.0, Angle::degrees);
            assert!((cured - sensor).abs() < 0.2, "{identifier} {sensor}: {cured}");
            vectors(&mut errors);
            let again = errors.sensor_to_cure().map_or(0.0, Angle::degrees);
            assert!(
                (again - cured).abs() < 0.1,
                "the cure of the one changes nothing of the other"
            );
            errors.remounted(Angle::from_degrees(cured));
            assert_eq!(errors.sensor(), None);
        }
    }

    #[test]
    fn places_where_the_map_misleads_do_not_count() {
        let noise = [0.4, -0.3, 0.1, -0.2];
        let about =
            |middle: f64, count: usize| (0..count).map(move |it| (middle + noise[it % 4], 0.4));
        let usual = |count| about(3.0, count);
        let all = estimate(usual(20).chain(about(0.5, 5)).collect()).unwrap();
        assert!((all.degrees - 3.0).abs() < 0.05, "{all:?}");
        // When there are too many of them nobody knows.
        assert_eq!(estimate(usual(16).chain(about(-7.0, 14)).collect()), None);
        let halves = estimate(usual(15).chain(about(0.5, 15)).collect());
        assert!(halves.is_none_or(|it| !it.is_worth_a_cure()), "{halves:?}");
        assert_eq!(estimate(usual(2).collect()), None);
        // The deviation is the measurements' own, or what they scatter by.
        let apart = estimate(usual(16).collect()).unwrap().deviation;
        assert!((0.1..0.11).contains(&apart), "{apart}");
        let scattered = usual(16).map(|(degrees, _)| (3.0 + 10.0 * (degrees - 3.0), 0.4));
        let scattered = estimate(scattered.collect()).unwrap().deviation;
        assert!((0.6..1.0).contains(&scattered), "{scattered}");
    }

    #[test]
    fn a_longer_stretch_says_more_of_the_course_than_its_parts() {
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
        // It is one stretch, and what it came to is not forgotten when it is over.
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
