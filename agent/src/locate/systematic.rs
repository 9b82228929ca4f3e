//! The systematic errors of odometry (Borenstein and Feng 1996: unequal wheel diameters, wrong
//! wheelbase). They are learnt where cameras see the robot, and corrected everywhere.
//!
//! Three parameters describe them: the scale error of distances, the scale error of turns, and the
//! drift of the heading per distance driven straight. They dominate the error where no camera sees
//! the robot: random errors grow with the square root of the distance, systematic ones with the
//! distance itself.

use libm::sqrtf;
use ubimap_protocol::{
    message::Certainty,
    time::Instant,
    units::{Angle, Millimetres, Pose},
};

use super::odometry::{MotionNoise, OdometryNoise};
use crate::trigonometry::{RADIANS, radians, round, sin_cos};

/// Two fixes are compared if the motion between them is at least `MIN_WAY` millimetres with a turn
/// below `MAX_BEND` radians, or a turn from `MIN_TURN` to `MAX_TURN`; and takes at most
/// `MAX_MICROS` microseconds.
const MIN_WAY: f32 = 1_000.0;
const MAX_BEND: f32 = 0.17;
const MIN_TURN: f32 = 0.5;
const MAX_TURN: f32 = 2.6;
const MAX_MICROS: u32 = 20_000_000;
/// Maximum standard deviations of a fix to learn from, in millimetres and binary angle units.
const SURE: Certainty = Certainty { x: 20, y: 20, heading: 182 };
/// Maximum scale error (20 %) and drift (6 degrees per metre); beyond these, the robot is
/// defective.
const MAX_SCALE: f32 = 0.2;
const MAX_DRIFT: f32 = 1.0e-4;
/// Minimum distance between two readings that counts as a jump and not as a motion, in millimetres.
const JUMP: f32 = 1_000.0;
/// Relative growth of the variance with each lesson, so that later ones still count as the robot
/// wears.
const DOUBT: f32 = 1.0e-3;

/// A learnt parameter and its variance.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Learnt {
    value: f32,
    variance: f32,
}

impl Learnt {
    /// A parameter before the first lesson. Half of the configured variance counts as systematic,
    /// the other half as random.
    fn of(deviation: f32) -> Self {
        Self { value: 0.0, variance: 0.5 * deviation * deviation }
    }

    /// Updates the parameter by a measured error `off` with this variance, and limits it to `most`
    /// either way. Outliers, for example from a spinning wheel, are ignored.
    fn learn(&mut self, off: f32, variance: f32, most: f32) {
        let sum = self.variance + variance;
        if off * off > 9.0 * sum {
            return;
        }
        let gain = self.variance / sum.max(f32::MIN_POSITIVE);
        self.value = (self.value + gain * off).max(-most).min(most);
        self.variance *= 1.0 - gain + DOUBT;
    }
}

/// A fix, and the odometry at the same time.
#[derive(Clone, Copy, Debug)]
struct Anchor {
    /// The lower word of the fix's time, in microseconds.
    moment: u32,
    fix: Pose,
    odometry: Pose,
    /// Standard deviations in millimetres and binary angle units.
    position: u16,
    heading: u16,
}

/// The systematic errors of odometry.
#[derive(Debug)]
pub(super) struct SystematicErrors {
    /// Scale error of distances.
    way: Learnt,
    /// Scale error of turns.
    turn: Learnt,
    /// Drift of the heading: radians per mm driven straight.
    drift: Learnt,
    /// The last reading and its corrected pose, with the fraction of a millimetre that rounding
    /// left.
    last: Option<(Pose, Pose)>,
    rest: (f32, f32),
    /// The correction applied to the heading, in radians.
    turned: f32,
    anchor: Option<Anchor>,
}

impl SystematicErrors {
    /// No errors yet, with the variances that the noise implies.
    pub(super) fn new(noise: &OdometryNoise) -> Self {
        let angle = |angle: Angle| f32::from(angle.0) * RADIANS;
        Self {
            way: Learnt::of(noise.position_per_metre.0 as f32 / 1_000.0),
            turn: Learnt::of(angle(noise.heading_per_radian)),
            drift: Learnt::of(angle(noise.heading_per_metre) / 1_000.0),
            last: None,
            rest: (0.0, 0.0),
            turned: 0.0,
            anchor: None,
        }
    }

    /// Corrects a reading for the known errors: returns `base_link` in a corrected `odom`.
    pub(super) fn corrected(&mut self, reading: Pose) -> Pose {
        let Some((last, mut pose)) = self.last else {
            self.last = Some((reading, reading));
            return reading;
        };
        let (dx, dy) = ((reading.x - last.x).0 as f32, (reading.y - last.y).0 as f32);
        let turn = radians(reading.heading - last.heading);
        let way = sqrtf(dx * dx + dy * dy);
        let (sin, cos) = sin_cos(self.turned);
        let scale = if way < JUMP { 1.0 + self.way.value } else { 1.0 };
        if way < JUMP {
            self.turned += self.turn.value * turn + self.drift.value * way;
            self.turned = radians(crate::trigonometry::angle(self.turned)) + fraction(self.turned);
        }
        self.rest.0 += (dx * cos - dy * sin) * scale;
        self.rest.1 += (dx * sin + dy * cos) * scale;
        let whole = (round(self.rest.0), round(self.rest.1));
        self.rest = (self.rest.0 - whole.0, self.rest.1 - whole.1);
        pose.x = pose.x + Millimetres(whole.0 as i32);
        pose.y = pose.y + Millimetres(whole.1 as i32);
        pose.heading = reading.heading + crate::trigonometry::angle(self.turned);
        self.last = Some((reading, pose));
        pose
    }

    /// Learns from an accepted fix and the corrected odometry of the same time.
    pub(super) fn learn(
        &mut self,
        moment: Instant,
        fix: Pose,
        certainty: Certainty,
        odometry: Pose,
        noise: &MotionNoise,
    ) {
        let Certainty { x, y, heading } = certainty;
        let position = x.max(y);
        if position > SURE.x || heading > SURE.heading {
            return;
        }
        let new = Anchor { moment: moment.0 as u32, fix, odometry, position, heading };
        // For a fix older than the last one, the difference wraps to more than half of the range.
        let age = |last: &Anchor| new.moment.wrapping_sub(last.moment);
        let Some(last) =
            self.anchor.filter(|last| age(last) <= MAX_MICROS || age(last) > u32::MAX / 2)
        else {
            self.anchor = Some(new);
            return;
        };
        if age(&last) == 0 || age(&last) > u32::MAX / 2 {
            return;
        }
        let turn = radians(odometry.heading - last.odometry.heading);
        let way = distance(last.odometry, odometry);
        let turned = turn.abs();
        if way < MIN_WAY && turned < MIN_TURN {
            return;
        }
        self.anchor = Some(new);
        let square = |value: f32| value * value;
        let both = |one: u16, other: u16| square(f32::from(one)) + square(f32::from(other));
        let heading = both(heading, last.heading) * RADIANS * RADIANS;
        // The random half of the noise.
        let chance = 0.5 * (noise.heading_by_way * way + noise.heading_by_turn * turned);
        let seen = radians(fix.heading - last.fix.heading);
        let off = radians(crate::trigonometry::angle(seen - turn));
        if (MIN_TURN..MAX_TURN).contains(&turned) {
            let drift = self.drift.variance * way * way;
            let variance = (heading + chance + drift) / square(turn);
            self.turn.learn(off / turn, variance, MAX_SCALE);
        } else if turned < MAX_BEND {
            self.drift.learn(off / way, (heading + chance) / square(way), MAX_DRIFT);
            let position = both(position, last.position) + 0.5 * noise.position_by_way * way;
            let longer = distance(last.fix, fix) - way;
            self.way.learn(longer / way, position / square(way), MAX_SCALE);
        }
    }
}

fn distance(from: Pose, to: Pose) -> f32 {
    let (dx, dy) = ((to.x - from.x).0 as f32, (to.y - from.y).0 as f32);
    sqrtf(dx * dx + dy * dy)
}

/// The fraction of a binary angle unit in an angle.
fn fraction(angle: f32) -> f32 {
    let units = angle / RADIANS;
    (units - round(units)) * RADIANS
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise() -> MotionNoise {
        MotionNoise::of(&OdometryNoise::default())
    }

    /// A robot with three errors of its wheels drives and turns. Returns what it learns from exact
    /// fixes, and how far its corrected odometry strays afterwards, in metres and degrees.
    fn drive(slip: f64, turn_slip: f64, drift: f64) -> (SystematicErrors, f64, f64) {
        let mut errors = SystematicErrors::new(&OdometryNoise::default());
        let (mut truth, mut wheels) = ([0.0f64; 3], [0.0f64; 3]);
        let pose = |at: [f64; 3]| Pose::from_metres(at[0], at[1], at[2]);
        let mut origin = None;
        let mut last = Pose::default();
        for step in 0..40 * 60 {
            // Three seconds straight, one and a half to the left or right, then a short stop.
            let (leg, part) = (step / 100, step % 100);
            let (way, turn) = match part {
                0..60 => (0.02, 0.0),
                65..95 if leg % 3 == 2 => (0.0, -0.05),
                65..95 => (0.0, 0.05),
                _ => (0.0, 0.0),
            };
            let go = |at: &mut [f64; 3], way: f64, turn: f64| {
                at[2] += turn;
                at[0] += way * libm::cos(at[2]);
                at[1] += way * libm::sin(at[2]);
            };
            go(&mut truth, way, turn);
            let wrong = turn / (1.0 + turn_slip) - drift * way;
            go(&mut wheels, way / (1.0 + slip), wrong);
            let odometry = errors.corrected(pose(wheels));
            // During a turn, the odometry's heading at the time of a fix is too imprecise.
            if leg < 12 && turn == 0.0 {
                let certainty = Certainty { x: 3, y: 3, heading: 30 };
                errors.learn(Instant(step * 50_000), pose(truth), certainty, odometry, &noise());
                origin = Some((pose(truth), odometry));
            }
            last = odometry;
        }
        // Relative to the last fix.
        let (seen, then) = origin.unwrap();
        let turn = (seen.heading - then.heading).radians();
        let (dx, dy) = ((last.x - then.x).metres(), (last.y - then.y).metres());
        let x = seen.x.metres() + dx * libm::cos(turn) - dy * libm::sin(turn);
        let y = seen.y.metres() + dx * libm::sin(turn) + dy * libm::cos(turn);
        let off = libm::hypot(x - truth[0], y - truth[1]);
        let heading =
            (last.heading + (seen.heading - then.heading) - pose(truth).heading).degrees();
        (errors, off, heading.abs())
    }

    #[test]
    fn learnt_errors_are_corrected_in_blind_ground() {
        // 2 % of slip, one degree per metre.
        let degree = 1.0f64.to_radians();
        for (slip, turn_slip, drift) in
            [(0.02, 0.0, degree), (-0.01, 0.01, 0.0), (0.01, -0.02, -0.5 * degree)]
        {
            // Then 14 m and twelve turns, on which uncorrected odometry would be 15 degrees off.
            let (errors, off, heading) = drive(slip, turn_slip, drift);
            assert!(off <= 0.1 && heading <= 3.0, "{off} m, {heading} degrees: {errors:?}");
            assert!((f64::from(errors.way.value) - slip).abs() < 0.003, "{errors:?}");
            assert!((f64::from(errors.turn.value) - turn_slip).abs() < 0.003, "{errors:?}");
            // The filter allows for random errors, although there are none here.
            let drift_per_mm = f64::from(errors.drift.value) * 1_000.0;
            assert!((drift_per_mm - drift).abs() < 0.2 * degree, "{errors:?}");
        }
    }

    #[test]
    fn readings_are_unchanged_before_anything_is_learnt() {
        let mut errors = SystematicErrors::new(&OdometryNoise::default());
        for (x, y, degrees) in [(0, 0, 0.0), (17, -4, 8.0), (900, 40, 170.0), (90_000, -7, -170.0)]
        {
            let reading = Pose {
                x: Millimetres(x),
                y: Millimetres(y),
                heading: Angle::from_degrees(degrees),
            };
            assert_eq!(errors.corrected(reading), reading);
        }
    }

    #[test]
    fn a_spinning_wheel_is_ignored() {
        let (errors, ..) = drive(0.01, 0.0, 0.0);
        let before = (errors.way, errors.drift);
        let mut errors = errors;
        errors.anchor = None;
        let certainty = Certainty { x: 3, y: 3, heading: 30 };
        let at = |x: f64| Pose::from_metres(x, 0.0, 0.0);
        errors.learn(Instant(200_000_000), at(0.0), certainty, at(0.0), &noise());
        errors.learn(Instant(205_000_000), at(0.4), certainty, at(1.2), &noise());
        assert_eq!(errors.way, before.0);
        assert!((errors.drift.value - before.1.value).abs() < 1.0e-7);
    }
}
