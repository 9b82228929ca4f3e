//! The systematic errors of odometry (Borenstein and Feng 1996 name them: wheels of other sizes and
//! another distance than is thought): learnt where cameras see the robot, taken out everywhere.
//!
//! Three numbers stand for them: how much longer a way is than odometry says, how much wider a turn
//! is, and by how much the heading turns on a metre of straight way. They are what makes a robot
//! stray in blind ground: chance grows with the root of the way, these grow with the way.

use libm::sqrtf;
use ubimap_protocol::{
    message::Certainty,
    time::Instant,
    units::{Angle, Millimetres, Pose},
};

use super::odometry::{MotionNoise, OdometryNoise};
use crate::trigonometry::{RADIANS, radians, round, sin_cos};

/// Between two fixes that are compared: at least this way in millimetres, straight but for so much
/// in radians, or such a turn; no longer than this.
const WAY: f32 = 1_000.0;
const STRAIGHT: f32 = 0.17;
const TURN: f32 = 0.5;
const WIDEST_TURN: f32 = 2.6;
const LONGEST_MICROS: u32 = 20_000_000;
/// Fixes that are less sure than this teach nothing.
const SURE: Certainty = Certainty { x: 20, y: 20, heading: 182 };
/// Nothing is learnt beyond a fifth, or 6 degrees on a metre: then something is broken.
const MOST: f32 = 0.2;
const MOST_DRIFT: f32 = 1.0e-4;
/// A reading further from the one before is no motion, in millimetres.
const JUMP: f32 = 1_000.0;
/// Wheels wear: of what has been learnt so much is doubted again with each lesson.
const DOUBT: f32 = 1.0e-3;

/// A number that is learnt, and its variance.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Learnt {
    value: f32,
    variance: f32,
}

impl Learnt {
    /// Half of the noise that is allowed for is systematic, the other half chance.
    fn of(deviation: f32) -> Self {
        Self { value: 0.0, variance: 0.5 * deviation * deviation }
    }

    /// A measurement says that it is off by so much, with this variance. What is far beyond both is
    /// a wheel that spun.
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

/// A fix, and where odometry said that the robot was.
#[derive(Clone, Copy, Debug)]
struct Anchor {
    /// The lower word of the moment, in microseconds.
    moment: u32,
    fix: Pose,
    odometry: Pose,
    /// Standard deviations in millimetres and binary angle units.
    position: u16,
    heading: u16,
}

/// What odometry gets wrong each time in the same way.
#[derive(Debug)]
pub(super) struct SystematicErrors {
    /// The share by which a way is longer.
    way: Learnt,
    /// The share by which a turn is wider.
    turn: Learnt,
    /// The turn on straight way: radians for each mm.
    drift: Learnt,
    /// The last reading as it came, and what it was taken for, with what is left of a millimetre.
    last: Option<(Pose, Pose)>,
    rest: (f32, f32),
    /// What the heading has been put right by, in radians.
    turned: f32,
    anchor: Option<Anchor>,
}

impl SystematicErrors {
    /// Nothing is known but how large such errors may be.
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

    /// A reading without the errors that are known: `base_link` in an `odom` of its own.
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

    /// Compares a fix that was taken in with what corrected odometry says of the same moment.
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
        // An older fix lies more than half of the word ahead.
        let age = |last: &Anchor| new.moment.wrapping_sub(last.moment);
        let Some(last) =
            self.anchor.filter(|last| age(last) <= LONGEST_MICROS || age(last) > u32::MAX / 2)
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
        if way < WAY && turned < TURN {
            return;
        }
        self.anchor = Some(new);
        let square = |value: f32| value * value;
        let both = |one: u16, other: u16| square(f32::from(one)) + square(f32::from(other));
        let heading = both(heading, last.heading) * RADIANS * RADIANS;
        // Half of the noise is chance.
        let chance = 0.5 * (noise.heading_by_way * way + noise.heading_by_turn * turned);
        let seen = radians(fix.heading - last.fix.heading);
        let off = radians(crate::trigonometry::angle(seen - turn));
        if (TURN..WIDEST_TURN).contains(&turned) {
            let drift = self.drift.variance * way * way;
            let variance = (heading + chance + drift) / square(turn);
            self.turn.learn(off / turn, variance, MOST);
        } else if turned < STRAIGHT {
            self.drift.learn(off / way, (heading + chance) / square(way), MOST_DRIFT);
            let position = both(position, last.position) + 0.5 * noise.position_by_way * way;
            let longer = distance(last.fix, fix) - way;
            self.way.learn(longer / way, position / square(way), MOST);
        }
    }
}

fn distance(from: Pose, to: Pose) -> f32 {
    let (dx, dy) = ((to.x - from.x).0 as f32, (to.y - from.y).0 as f32);
    sqrtf(dx * dx + dy * dy)
}

/// What is left of an angle by whole binary units.
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

    /// A robot that drives and turns, and its wheels that are wrong in three ways: what it learns
    /// from exact fixes, and how far its corrected odometry strays on the way after them.
    fn drive(slip: f64, turn_slip: f64, drift: f64) -> (SystematicErrors, f64, f64) {
        let mut errors = SystematicErrors::new(&OdometryNoise::default());
        let (mut truth, mut wheels) = ([0.0f64; 3], [0.0f64; 3]);
        let pose = |at: [f64; 3]| Pose::from_metres(at[0], at[1], at[2]);
        let mut origin = None;
        let mut last = Pose::default();
        for step in 0..40 * 60 {
            // Three seconds straight on, one and a half to the left or right, then standing a bit.
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
            // A fix in a turn says too little of where the wheels were.
            if leg < 12 && turn == 0.0 {
                let certainty = Certainty { x: 3, y: 3, heading: 30 };
                errors.learn(Instant(step * 50_000), pose(truth), certainty, odometry, &noise());
                origin = Some((pose(truth), odometry));
            }
            last = odometry;
        }
        // From where the fixes ended.
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
    fn wheels_that_are_wrong_are_put_right_where_nobody_sees_them() {
        // The robot: 2 % of slip, a degree on a metre.
        let degree = 1.0f64.to_radians();
        for (slip, turn_slip, drift) in
            [(0.02, 0.0, degree), (-0.01, 0.01, 0.0), (0.01, -0.02, -0.5 * degree)]
        {
            // 14 m and twelve turns follow, on which the wheels alone would be 15 degrees off.
            let (errors, off, heading) = drive(slip, turn_slip, drift);
            assert!(off <= 0.1 && heading <= 3.0, "{off} m, {heading} degrees: {errors:?}");
            assert!((f64::from(errors.way.value) - slip).abs() < 0.003, "{errors:?}");
            assert!((f64::from(errors.turn.value) - turn_slip).abs() < 0.003, "{errors:?}");
            // The learner must allow for chance, of which there is none here.
            let drift_per_mm = f64::from(errors.drift.value) * 1_000.0;
            assert!((drift_per_mm - drift).abs() < 0.2 * degree, "{errors:?}");
        }
    }

    #[test]
    fn nothing_learnt_leaves_every_reading_as_it_is() {
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
    fn a_wheel_that_spins_teaches_nothing() {
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
