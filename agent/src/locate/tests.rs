//! Compares the filter with a batch filter, and tests arbitrary input.

use core::f64::consts::{PI, TAU};
use std::{format, vec::Vec};

use nalgebra::{Matrix3, Vector3};
use proptest::prelude::*;
use ubimap_protocol::{
    message::Certainty,
    time::Instant,
    units::{Angle, Millimetres, Pose},
};

use super::{
    FixOutcome, Located, Locator, OdometryNoise, PoseSource, UncertaintyLimit, estimate::Fix,
    filter::Filter, odometry::MotionNoise,
};

const GATE: f64 = 16.27;
const BRIDGED_GAP: u64 = 350_000;
const UNKNOWN: [f64; 3] = [6.0e6, 6.0e6, 6.6];

/// Relative distance from the gate within which rounding may decide: odometry is rounded to a
/// millimetre, and the gate is at four deviations of about 30 mm.
const ROUNDING: f64 = 0.03;

/// A measurement with its time.
type Timed<T> = (u64, T);

/// The textbook filter in double precision. Its state is (x, y, heading), the motion is in the
/// robot's frame, a fix takes one matrix inverse, and everything is computed again from the first
/// measurement.
#[derive(Clone, Copy)]
struct Textbook {
    mean: Vector3<f64>,
    covariance: Matrix3<f64>,
}

/// The results of a run.
struct Run {
    end: Option<Textbook>,
    outcomes: Vec<FixOutcome>,
    /// The first time at which rounding may decide: a fix is too near the gate, or a variance too
    /// near its limit.
    doubt: Option<u64>,
}

impl Textbook {
    fn of(fix: &Fix) -> Self {
        Self { mean: state(fix.pose), covariance: Matrix3::from_diagonal(&variances(fix)) }
    }

    fn drive(&mut self, from: Vector3<f64>, to: Vector3<f64>, seconds: f64) {
        let (sin, cos) = libm::sincos(self.mean.z - from.z);
        let (x, y) = (to.x - from.x, to.y - from.y);
        let step = Vector3::new(cos * x - sin * y, sin * x + cos * y, wrap(to.z - from.z));
        let jacobian = Matrix3::new(1.0, 0.0, -step.y, 0.0, 1.0, step.x, 0.0, 0.0, 1.0);
        let way = libm::hypot(x, y) / 1000.0;
        let radians = |units: f64| units * TAU / 65_536.0;
        let position = 15.0 * 15.0 * way + 9.0 * seconds;
        let heading = radians(91.0) * radians(91.0) * way
            + radians(182.0) * radians(182.0) * step.z.abs()
            + 3.0e-6 * seconds;
        let noise = Matrix3::from_diagonal(&Vector3::new(position, position, heading));
        self.mean += step;
        if self.is_lost() {
            return;
        }
        self.covariance = jacobian * self.covariance * jacobian.transpose() + noise;
    }

    fn wander(&mut self, seconds: f64) {
        if !self.is_lost() {
            self.covariance += Matrix3::from_diagonal(&(Vector3::from(UNKNOWN) * seconds));
        }
    }

    fn is_lost(&self) -> bool {
        let p = &self.covariance;
        p.m11 + p.m22 > 1.0e8 || p.m33 > 1.0
    }

    /// Processes a fix unless it is beyond the gate. Returns the squared Mahalanobis distance.
    fn take(&mut self, fix: &Fix) -> f64 {
        let noise = Matrix3::from_diagonal(&variances(fix));
        let mut innovation = state(fix.pose) - self.mean;
        innovation.z = wrap(innovation.z);
        let inverse = (self.covariance + noise).try_inverse().unwrap();
        let distance = innovation.dot(&(inverse * innovation));
        if distance <= GATE {
            let gain = self.covariance * inverse;
            self.mean += gain * innovation;
            let rest = Matrix3::identity() - gain;
            self.covariance =
                rest * self.covariance * rest.transpose() + gain * noise * gain.transpose();
        }
        distance
    }

    fn run(readings: &[Timed<Pose>], fixes: &[Timed<Fix>], until: u64) -> Run {
        let mut run = Run { end: None, outcomes: Vec::new(), doubt: None };
        let mut rival: Option<(Self, u32)> = None;
        // The odometry at the last step, if known.
        let mut last: (u64, Option<Vector3<f64>>) = (0, None);
        let mut moments: Vec<u64> = readings.iter().map(|(moment, _)| *moment).collect();
        moments.extend(fixes.iter().map(|(moment, _)| *moment));
        moments.push(until);
        moments.retain(|moment| *moment <= until);
        moments.sort_unstable();
        moments.dedup();
        for moment in moments {
            let odometry = odometry_at(readings, moment);
            let seconds = (moment - last.0) as f64 / 1e6;
            for estimate in run.end.iter_mut().chain(rival.iter_mut().map(|(rival, _)| rival)) {
                match (last.1, odometry) {
                    (Some(from), Some(to)) => estimate.drive(from, to, seconds),
                    _ => estimate.wander(seconds),
                }
            }
            last = (moment, odometry);
            for (_, fix) in fixes.iter().filter(|(time, _)| *time == moment) {
                let outcome = run.take(&mut rival, fix, moment);
                run.outcomes.push(outcome);
            }
        }
        run
    }
}

impl Run {
    fn take(&mut self, rival: &mut Option<(Textbook, u32)>, fix: &Fix, now: u64) -> FixOutcome {
        let doubt = &mut self.doubt;
        let mut compare = |value: f64, with: f64| {
            if (value / with - 1.0).abs() < ROUNDING {
                doubt.get_or_insert(now);
            }
            value <= with
        };
        for estimate in self.end.iter().chain(rival.iter().map(|(rival, _)| rival)) {
            compare(estimate.covariance.m33, 1.0);
        }
        let Some(estimate) = self.end.as_mut().filter(|estimate| !estimate.is_lost()) else {
            (self.end, *rival) = (Some(Textbook::of(fix)), None);
            return FixOutcome::Began;
        };
        let mut near = |estimate: &mut Textbook| compare(estimate.take(fix), GATE);
        if near(estimate) {
            *rival = None;
            return FixOutcome::Taken;
        }
        let agreed = rival
            .filter(|(other, _)| !other.is_lost())
            .and_then(|(mut other, count)| near(&mut other).then_some((other, count + 1)));
        let (other, count) = agreed.unwrap_or_else(|| (Textbook::of(fix), 1));
        *rival = Some((other, count));
        if count < 5 {
            return FixOutcome::Rejected;
        }
        (self.end, *rival) = (Some(other), None);
        FixOutcome::Moved
    }
}

/// Interpolates between two readings, if they are close in time.
fn odometry_at(readings: &[Timed<Pose>], moment: u64) -> Option<Vector3<f64>> {
    let after = readings.iter().find(|(time, _)| *time >= moment)?;
    if after.0 == moment {
        return Some(state(after.1));
    }
    let before = readings.iter().rfind(|(time, _)| *time < moment)?;
    let part = (moment - before.0) as f64 / (after.0 - before.0) as f64;
    let mut way = state(after.1) - state(before.1);
    way.z = wrap(way.z);
    (after.0 - before.0 <= BRIDGED_GAP).then(|| state(before.1) + way * part)
}

fn state(pose: Pose) -> Vector3<f64> {
    Vector3::new(f64::from(pose.x.0), f64::from(pose.y.0), pose.heading.radians())
}

fn variances(fix: &Fix) -> Vector3<f64> {
    let Certainty { x, y, heading } = fix.certainty;
    let heading = f64::from(heading) * TAU / 65_536.0;
    Vector3::new(f64::from(x), f64::from(y), heading).map(|deviation| deviation * deviation)
}

fn wrap(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

/// The measurements of a drive.
#[derive(Clone, Debug)]
struct Drive {
    readings: Vec<Timed<Pose>>,
    fixes: Vec<Timed<Fix>>,
    /// Delay of each fix.
    lateness: Vec<u64>,
}

fn drive() -> impl Strategy<Value = Drive> {
    let steps = proptest::collection::vec(
        (
            // Time between readings: mostly short, sometimes a gap.
            prop_oneof![9 => 100_000..150_000u64, 1 => 150_000..800_000u64],
            // Speed in mm/s and turn rate in binary angle units per second.
            (-300..1_500i32, -8_000..8_000i32),
            // Time between fixes, their errors and their delay.
            (60_000..180_000u64, -30..30i32, -30..30i32, -200..200i32, 0..300_000u64),
            // Some of these values stand for an outlier, or for a robot that is carried off.
            0..60u32,
        ),
        20..120,
    );
    (steps, -50_000_000..50_000_000i32, any::<u16>(), any::<bool>()).prop_map(
        |(steps, origin, heading, wheels)| {
            let mut drive = Drive { readings: Vec::new(), fixes: Vec::new(), lateness: Vec::new() };
            let (mut truth, mut odometry) = (Vector3::zeros(), Vector3::zeros());
            let (mut now, mut next_fix, mut carried) = (1_000_000, 1_000_000, 0);
            let pose = |at: Vector3<f64>| Pose {
                x: Millimetres(at.x as i32),
                y: Millimetres(at.y as i32),
                heading: Angle::from_radians(at.z),
            };
            for (span, (speed, turn), (between_fixes, x, y, turned, late), fate) in steps {
                carried += i32::from(fate == 0) * 4_000;
                let absurd = i32::from(fate == 1) * 3_000;
                let go = |at: Vector3<f64>, micros: u64, error: f64| {
                    let seconds = micros as f64 / 1e6;
                    let way = f64::from(speed) * seconds * (1.0 + error);
                    let heading = at.z + f64::from(turn) * TAU / 65_536.0 * seconds * (1.0 - error);
                    let (sin, cos) = libm::sincos(heading);
                    Vector3::new(at.x + cos * way, at.y + sin * way, heading)
                };
                while next_fix < now + span {
                    let seen = pose(go(truth, next_fix - now, 0.0));
                    let pose = Pose {
                        x: seen.x + Millimetres(origin + x + carried + absurd),
                        y: seen.y + Millimetres(y - origin),
                        heading: seen.heading + Angle(heading) + Angle(turned as u16),
                    };
                    let certainty = Certainty { x: 20, y: 25, heading: 182 };
                    drive.fixes.push((next_fix, Fix { pose, certainty }));
                    drive.lateness.push(late);
                    next_fix += between_fixes;
                }
                now += span;
                truth = go(truth, span, 0.0);
                odometry = go(odometry, span, 0.01);
                if wheels {
                    drive.readings.push((now, pose(odometry)));
                }
            }
            drive.beyond_doubt()
        },
    )
}

impl Drive {
    /// Cuts the drive before the point where rounding might decide.
    fn beyond_doubt(mut self) -> Self {
        while let Some(doubt) = Textbook::run(&self.readings, &self.fixes, u64::MAX).doubt {
            self.readings.retain(|(moment, _)| *moment < doubt);
            self.fixes.retain(|(moment, _)| *moment < doubt);
        }
        self
    }
}

fn filter() -> Filter {
    Filter::new(MotionNoise::of(&OdometryNoise::default()), None)
}

proptest! {
    /// Measurements arrive late, yet the result is that of processing all of them in order.
    #[test]
    fn late_fixes_end_where_a_batch_of_all_ends(drive in drive()) {
        let Drive { readings, fixes, lateness } = &drive;
        // Readings arrive immediately, fixes late.
        let mut arrivals: Vec<(u64, Result<usize, usize>)> =
            readings.iter().enumerate().map(|(index, (moment, _))| (*moment, Ok(index))).collect();
        for (index, ((moment, _), late)) in fixes.iter().zip(lateness).enumerate() {
            arrivals.push((moment + late, Err(index)));
        }
        arrivals.sort_by_key(|(moment, _)| *moment);

        let mut filter = filter();
        let mut end = 0;
        for (_, arrival) in arrivals {
            match arrival {
                Ok(index) => {
                    let (moment, pose) = readings[index];
                    filter.odometry(Instant(moment), pose);
                    end = end.max(moment);
                }
                Err(index) => {
                    let (moment, fix) = fixes[index];
                    let at = Instant(moment);
                    let fixed = filter.fix(at, at, fix.pose, fix.certainty);
                    prop_assert!(fixed.is_ok(), "{fixed:?}");
                    end = end.max(moment);
                }
            }
        }
        let Some(expected) = Textbook::run(readings, fixes, end).end else { return Ok(()) };
        let found = filter.at(Instant(end)).unwrap();
        let off = state(found.pose) - expected.mean;
        prop_assert!(off.x.abs() <= 2.5 && off.y.abs() <= 2.5, "{off:?} mm");
        prop_assert!(wrap(off.z).abs() <= 3.0 * TAU / 65_536.0, "{off:?} rad");
        let p = expected.covariance;
        for (found, expected) in
            [(found.variances.position, p.m11 + p.m22), (found.variances.heading, p.m33)]
        {
            let ratio = f64::from(found) / expected;
            prop_assert!((0.99..1.01).contains(&ratio), "{found} for {expected}");
        }
    }

    /// In order of time, each fix has the same outcome as in the batch.
    #[test]
    fn the_gate_and_the_rivals_are_those_of_the_batch(drive in drive()) {
        let batch = Textbook::run(&drive.readings, &drive.fixes, u64::MAX);
        let mut filter = filter();
        let (mut readings, mut newest) = (drive.readings.iter(), 0);
        let mut outcomes = Vec::new();
        for (moment, fix) in &drive.fixes {
            // The reading after the fix has arrived, too.
            while newest < *moment && let Some((reading, pose)) = readings.next() {
                filter.odometry(Instant(*reading), *pose);
                newest = *reading;
            }
            let at = Instant(*moment);
            outcomes.push(filter.fix(at, at, fix.pose, fix.certainty).unwrap().0);
        }
        prop_assert_eq!(outcomes, batch.outcomes);
    }

    /// Arbitrary input in any order: errors change nothing, and results are valid.
    #[test]
    fn no_input_upsets_it(
        offline in proptest::option::of(any_pose()),
        inputs in proptest::collection::vec(input(), 0..150),
    ) {
        let source = offline.map_or(PoseSource::Fixes, PoseSource::Odometry);
        let limit = UncertaintyLimit::default();
        let mut locator = Locator::new(source, &OdometryNoise::default(), limit);
        for input in inputs {
            let before = format!("{locator:?}");
            let failed = match input {
                Input::Odometry(moment, pose) => locator.odometry(moment, pose).is_err(),
                Input::Fix { server, local, pose, certainty, now } => {
                    locator.fix(server, local, pose, certainty, now).is_err()
                }
                Input::Ask(moment, now, last_chance) => {
                    let located = locator.at(moment, now, last_chance);
                    prop_assert!(!last_chance || located != Located::NotYet);
                    true
                }
            };
            prop_assert!(!failed || format!("{locator:?}") == before, "{input:?}");
        }
    }
}

#[derive(Clone, Copy, Debug)]
enum Input {
    Odometry(Instant, Pose),
    Fix { server: Instant, local: Option<Instant>, pose: Pose, certainty: Certainty, now: Instant },
    Ask(Instant, Instant, bool),
}

/// A time, mostly within the first few seconds.
fn moment() -> impl Strategy<Value = Instant> {
    prop_oneof![8 => 0..5_000_000u64, 1 => any::<u64>(), 1 => u64::MAX - 9..=u64::MAX]
        .prop_map(Instant)
}

/// A pose, mostly within a room.
fn any_pose() -> impl Strategy<Value = Pose> {
    let coordinate = || prop_oneof![4 => -5_000..5_000i32, 1 => any::<i32>()];
    (coordinate(), coordinate(), any::<u16>()).prop_map(|(x, y, heading)| Pose {
        x: Millimetres(x),
        y: Millimetres(y),
        heading: Angle(heading),
    })
}

fn input() -> impl Strategy<Value = Input> {
    let certainty = (any::<u16>(), any::<u16>(), any::<u16>())
        .prop_map(|(x, y, heading)| Certainty { x, y, heading });
    let fix = (moment(), proptest::option::of(moment()), any_pose(), certainty, moment());
    prop_oneof![
        (moment(), any_pose()).prop_map(|(moment, pose)| Input::Odometry(moment, pose)),
        fix.prop_map(|(server, local, pose, certainty, now)| Input::Fix {
            server,
            local,
            pose,
            certainty,
            now
        }),
        (moment(), moment(), any::<bool>())
            .prop_map(|(moment, now, last)| Input::Ask(moment, now, last)),
    ]
}
