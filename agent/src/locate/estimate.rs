//! The steps of a Kalman filter with three states (x, y, heading): prediction by a motion,
//! correction by a fix.

use libm::sqrtf;
use nalgebra::{UnitComplex, Vector2, Vector3};
use ubimap_protocol::{
    message::Certainty,
    units::{Angle, Millimetres, Pose},
};

use super::{
    covariance::{Axis, Covariance},
    odometry::MotionNoise,
};
use crate::trigonometry::{RADIANS, radians, round, sin_cos};

/// Gate for fixes: squared Mahalanobis distance, which is chi-squared with three degrees of
/// freedom. Rejects one good fix in a thousand.
const GATE: f32 = 16.27;

/// Growth of the variances while the motion is unknown, in mm^2/s and rad^2/s. Between two frames
/// at 15 Hz the deviations grow by 0.63 m and 38 degrees: enough that the estimate of a robot at 1
/// m/s lags less than a millimetre behind fixes accurate to 5 cm.
const UNKNOWN_POSITION: f32 = 6.0e6;
const UNKNOWN_HEADING: f32 = 6.6;

/// Unknown accelerations of the robot between two odometry readings: standard deviations in mm/s^2
/// and rad/s^2. In 50 ms they amount to 1.3 mm and 0.4 degrees.
const ACCELERATION: f32 = 1_000.0;
const TURN_ACCELERATION: f32 = 6.0;
/// Unknown speeds while there are fewer than two readings: standard deviations in mm/s and rad/s.
const SPEED: f32 = 500.0;
const TURN_SPEED: f32 = 1.5;

/// Variances of the position (10 m squared) and the heading (1 rad squared) beyond which an
/// estimate counts as lost: the filter is linear for small errors only.
const LOST_POSITION: f32 = 1.0e8;
const LOST_HEADING: f32 = 1.0;

/// A measured pose of the robot and its certainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Fix {
    pub(super) pose: Pose,
    pub(super) certainty: Certainty,
}

impl Fix {
    /// The fix's variances. No deviation is smaller than one unit, the resolution on the wire.
    fn variances(&self) -> Vector3<f32> {
        let Certainty { x, y, heading } = self.certainty;
        let deviations = Vector3::new(
            f32::from(x.max(1)),
            f32::from(y.max(1)),
            f32::from(heading.max(1)) * RADIANS,
        );
        deviations.component_mul(&deviations)
    }
}

/// Uncertainty of a pose.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Variances {
    /// Variance of the distance to the true position, in mm^2.
    pub position: f32,
    /// Variance of the heading, in rad^2.
    pub heading: f32,
}

impl Variances {
    /// The distance from the robot, at most `most` mm, up to which one standard deviation of the
    /// heading displaces points by at most `side`.
    pub(crate) fn reach(self, side: Millimetres, most: u16) -> u16 {
        let (side, far) = (side.0 as f32, f32::from(most));
        if self.heading * far * far <= side * side {
            return most;
        }
        // The heading has a variance here, so the quotient is finite; the cast saturates.
        (side / libm::sqrtf(self.heading)) as u16
    }

    /// The variances after `seconds` of unknown motion.
    pub(super) fn after(self, seconds: f32) -> Self {
        Self {
            position: self.position + 2.0 * UNKNOWN_POSITION * seconds,
            heading: self.heading + UNKNOWN_HEADING * seconds,
        }
    }

    /// The variances interpolated between two poses; `part` is 0 to 1.
    pub(super) fn between(self, to: Self, part: f32) -> Self {
        let mix = |from: f32, to: f32| from * (1.0 - part) + to * part;
        Self { position: mix(self.position, to.position), heading: mix(self.heading, to.heading) }
    }
}

/// An estimated pose and its covariance.
///
/// Computed in single precision, with identical bits on a Cortex-M4F and on a PC: it uses only the
/// four operations, and `libm`'s square root and arc tangent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Estimate {
    /// The position rounded to whole millimetres. Integers keep the precision independent of the
    /// distance from the origin.
    whole: (Millimetres, Millimetres),
    /// What rounding left of the position, at most half a millimetre along each axis.
    rest: Vector2<f32>,
    /// The rotation from `odom` to `map`; a new odometry reading does not change it.
    rotation: UnitComplex<f32>,
    covariance: Covariance,
    /// Whether part of the motion since the last fix is unknown.
    guessed: bool,
}

impl Estimate {
    /// An exactly known pose; the odometry's heading at that time is `odometry`.
    pub(super) fn certain(pose: Pose, odometry: Angle) -> Self {
        Self {
            whole: (pose.x, pose.y),
            rest: Vector2::zeros(),
            rotation: rotation(radians(pose.heading - odometry)),
            covariance: Covariance::diagonal(Vector3::zeros()),
            guessed: false,
        }
    }

    /// The estimate from a fix alone; the odometry's heading at that time is `odometry`.
    pub(super) fn of(fix: &Fix, odometry: Angle) -> Self {
        let covariance = Covariance::diagonal(fix.variances());
        Self { covariance, ..Self::certain(fix.pose, odometry) }
    }

    /// `base_link` in `map`, when the odometry's heading is `odometry`.
    pub(super) fn pose(&self, odometry: Angle) -> Pose {
        let turned = round(self.rotation.angle() / RADIANS) as i32 as u16;
        Pose { x: self.whole.0, y: self.whole.1, heading: odometry + Angle(turned) }
    }

    /// The uncertainty of the pose.
    pub(super) fn variances(&self) -> Variances {
        let position = self.covariance.xx + self.covariance.yy;
        Variances { position, heading: self.covariance.hh }
    }

    /// Whether part of the motion since the last fix is unknown.
    pub(super) fn is_guessed(&self) -> bool {
        self.guessed
    }

    /// Whether the variances exceed the limit at which the pose counts as lost. Beyond it they no
    /// longer grow.
    pub(super) fn is_lost(&self) -> bool {
        let Variances { position, heading } = self.variances();
        position > LOST_POSITION || heading > LOST_HEADING
    }

    /// Predicts a motion of `seconds` that odometry measured from one pose in `odom` to another.
    /// About 350 instructions.
    pub(super) fn drive(&mut self, from: Pose, to: Pose, seconds: f32, noise: &MotionNoise) {
        let way = Vector2::new((to.x - from.x).0 as f32, (to.y - from.y).0 as f32);
        let step = self.rotation * way;
        self.shift(step);
        if self.is_lost() {
            return;
        }
        self.covariance.carry(step);
        let length = sqrtf(way.norm_squared());
        let turn = radians(to.heading - from.heading).abs();
        self.covariance.grow(
            noise.position_by_way * length + noise.position_by_time * seconds,
            noise.heading_by_way * length
                + noise.heading_by_turn * turn
                + noise.heading_by_time * seconds,
        );
    }

    /// Predicts `seconds` of unknown motion: the pose stays the same, and its variances grow.
    pub(super) fn wander(&mut self, seconds: f32) {
        self.guessed = true;
        if !self.is_lost() {
            self.covariance.grow(UNKNOWN_POSITION * seconds, UNKNOWN_HEADING * seconds);
        }
    }

    /// Adds the uncertainty of an extrapolation by `seconds`. `has_speed` says whether it used a
    /// measured speed.
    pub(super) fn stray(&mut self, seconds: f32, has_speed: bool) {
        let gained = 0.5 * seconds * seconds;
        let (way, turn) = if has_speed {
            (ACCELERATION * gained, TURN_ACCELERATION * gained)
        } else {
            (SPEED * seconds, TURN_SPEED * seconds)
        };
        self.covariance.grow(way * way, turn * turn);
    }

    /// Adapts to a jump of the odometry's heading from `from` to `to` without a motion of the
    /// robot.
    pub(super) fn rebase(&mut self, from: Angle, to: Angle) {
        if from != to {
            self.rotation *= rotation(radians(from - to));
        }
    }

    /// Corrects the estimate by a fix. Returns `false` if the fix is beyond the gate; the estimate
    /// is then unchanged.
    ///
    /// As the covariance of a fix is diagonal, its three numbers can be processed one after
    /// another, which gives the same result and needs no matrix inverse.
    pub(super) fn take(&mut self, fix: &Fix, odometry: Angle) -> bool {
        let Pose { x, y, heading } = fix.pose;
        let innovation = Vector3::new(
            (x - self.whole.0).0 as f32 - self.rest.x,
            (y - self.whole.1).0 as f32 - self.rest.y,
            wrap(radians(heading - odometry) - self.rotation.angle()),
        );
        let mut correction = Vector3::zeros();
        let mut covariance = self.covariance;
        let mut distance = 0.0;
        let noise = fix.variances();
        for axis in [Axis::X, Axis::Y, Axis::Heading] {
            let column = covariance.column(axis);
            let scale = 1.0 / (axis.of(column) + axis.of(noise));
            let off = axis.of(innovation) - axis.of(correction);
            distance += off * off * scale;
            correction += column * (off * scale);
            covariance.reduce(column, scale);
        }
        let near = distance <= GATE;
        if near {
            self.covariance = covariance;
            self.guessed = false;
            self.shift(correction.xy());
            self.turn(correction.z);
        }
        near
    }

    /// Turns the rotation by an angle. Small angles, the usual case, need no sine or cosine: they
    /// use the tangent of the half angle, with an error below 10^-5.
    fn turn(&mut self, angle: f32) {
        self.rotation *= if angle.abs() < 0.25 {
            let tangent = 0.5 * angle * (1.0 + angle * angle / 12.0);
            let square = tangent * tangent;
            let (cos, sin) = ((1.0 - square) / (1.0 + square), 2.0 * tangent / (1.0 + square));
            UnitComplex::from_cos_sin_unchecked(cos, sin)
        } else {
            rotation(angle)
        };
        self.rotation.renormalize_fast();
    }

    fn shift(&mut self, step: Vector2<f32>) {
        let moved = self.rest + step;
        let (x, y) = (round(moved.x), round(moved.y));
        self.whole.0 = self.whole.0 + Millimetres(x as i32);
        self.whole.1 = self.whole.1 + Millimetres(y as i32);
        self.rest = moved - Vector2::new(x, y);
    }
}

fn rotation(radians: f32) -> UnitComplex<f32> {
    let (sin, cos) = sin_cos(radians);
    UnitComplex::from_cos_sin_unchecked(cos, sin)
}

/// Normalises an angle of less than three half turns to [-pi, pi].
fn wrap(radians: f32) -> f32 {
    use core::f32::consts::{PI, TAU};
    match radians {
        _ if radians > PI => radians - TAU,
        _ if radians < -PI => radians + TAU,
        _ => radians,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::locate::OdometryNoise;

    fn fix(x: i32, y: i32, heading: u16, deviation: u16) -> Fix {
        let pose = Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle(heading) };
        Fix { pose, certainty: Certainty { x: deviation, y: deviation, heading: deviation } }
    }

    fn is_positive(covariance: &Covariance) -> bool {
        let Covariance { xx, xy, yy, xh, yh, hh } = *covariance;
        let [xx, xy, yy, xh, yh, hh] = [xx, xy, yy, xh, yh, hh].map(f64::from);
        let minor = xx * yy - xy * xy;
        let determinant =
            xx * (yy * hh - yh * yh) - xy * (xy * hh - yh * xh) + xh * (xy * yh - yy * xh);
        determinant.is_finite() && xx > 0.0 && minor > 0.0 && determinant > 0.0
    }

    #[derive(Clone, Copy, Debug)]
    enum FilterInput {
        Drive(i32, i32, u16, f32),
        Wander(f32),
        Take(i32, i32, u16, u16),
    }

    fn step() -> impl Strategy<Value = FilterInput> {
        let way = || prop_oneof![8 => -200..200i32, 1 => -30_000..30_000i32, 1 => any::<i32>()];
        prop_oneof![
            8 => (way(), way(), any::<u16>(), 0.0..4_000.0f32)
                .prop_map(|(x, y, turn, seconds)| FilterInput::Drive(x, y, turn, seconds)),
            1 => (0.0..4_000.0f32).prop_map(FilterInput::Wander),
            // A fix that is off by up to half a metre, with any certainty.
            6 => (-500..500i32, -500..500i32, any::<u16>(), any::<u16>())
                .prop_map(|(x, y, turn, deviation)| FilterInput::Take(x, y, turn, deviation)),
        ]
    }

    proptest! {
        #[test]
        fn the_covariance_stays_positive(
            start in 0..500u16,
            steps in proptest::collection::vec(step(), 0..200),
        ) {
            let noise = MotionNoise::of(&OdometryNoise::default());
            let mut odometry = Pose::default();
            let mut estimate = Estimate::of(&fix(0, 0, 0, start), odometry.heading);
            for step in steps {
                match step {
                    FilterInput::Drive(x, y, turn, seconds) => {
                        let to = Pose {
                            x: odometry.x + Millimetres(x),
                            y: odometry.y + Millimetres(y),
                            heading: odometry.heading + Angle(turn),
                        };
                        estimate.drive(odometry, to, seconds, &noise);
                        odometry = to;
                    }
                    FilterInput::Wander(seconds) => estimate.wander(seconds),
                    FilterInput::Take(x, y, turn, deviation) if !estimate.is_lost() => {
                        let Pose { x: at_x, y: at_y, heading } = estimate.pose(odometry.heading);
                        let turn = Angle((turn as i16 / 20) as u16);
                        let seen = fix(at_x.0, at_y.0, (heading + turn).0, deviation);
                        let pose = Pose {
                            x: seen.pose.x + Millimetres(x),
                            y: seen.pose.y + Millimetres(y),
                            ..seen.pose
                        };
                        estimate.take(&Fix { pose, ..seen }, odometry.heading);
                    }
                    FilterInput::Take(..) => {}
                }
                prop_assert!(is_positive(&estimate.covariance), "{estimate:?} after {step:?}");
                let length = estimate.rotation.into_inner().norm_sqr();
                prop_assert!((length - 1.0).abs() < 1e-5, "{estimate:?} after {step:?}");
                prop_assert!(estimate.rest.amax() <= 0.5);
            }
        }
    }

    #[test]
    fn two_equal_fixes_halve_the_variances() {
        let mut estimate = Estimate::of(&fix(1000, 2000, 100, 20), Angle(0));
        assert!(estimate.take(&fix(1010, 1990, 120, 20), Angle(0)));
        let expected = Pose { x: Millimetres(1005), y: Millimetres(1995), heading: Angle(110) };
        assert_eq!(estimate.pose(Angle(0)), expected);
        let Variances { position, heading } = estimate.variances();
        assert!((position - 400.0).abs() < 0.01, "{position}");
        let one = (20.0 * RADIANS).powi(2);
        assert!((heading / one - 0.5).abs() < 1e-4, "{heading}");
    }

    #[test]
    fn the_gate_is_at_the_last_thousandth_of_chi_squared() {
        // The estimate and the fix both have a variance of 400 mm^2, so the squared distance is
        // divided by 800 mm^2.
        let estimate = Estimate::of(&fix(0, 0, 0, 20), Angle(0));
        let passes = |x, y| { estimate }.take(&fix(x, y, 0, 20), Angle(0));
        // The square root of 16.27 * 800 is 114.09 mm.
        assert!(passes(114, 0) && !passes(115, 0));
        assert!(passes(-80, 81) && !passes(81, -81));
    }

    #[test]
    fn the_precision_does_not_depend_on_the_distance_from_the_origin() {
        let noise = MotionNoise::of(&OdometryNoise::default());
        let far = 2_000_000_000;
        let run = |origin: i32| {
            let mut estimate = Estimate::of(&fix(origin, -origin, 9_000, 20), Angle(0));
            let mut odometry = Pose::default();
            for _ in 0..1_000 {
                let to = Pose { x: odometry.x + Millimetres(33), ..odometry };
                estimate.drive(odometry, to, 0.05, &noise);
                odometry = to;
            }
            let pose = estimate.pose(odometry.heading);
            (pose.x.0 - origin, pose.y.0 + origin, pose.heading)
        };
        assert_eq!(run(far), run(0));
        // 33 m at 49.4 degrees.
        let (sin, cos) = libm::sincos(Angle(9_000).radians());
        let expected = (libm::round(33_000.0 * cos) as i32, libm::round(33_000.0 * sin) as i32);
        assert_eq!((run(0).0, run(0).1), expected);
    }

    #[test]
    fn an_uncertain_heading_makes_the_position_uncertain_across_the_way() {
        // A heading deviation of one degree, after 10 m: 175 mm across the way, none along it.
        let noise = MotionNoise::default();
        let mut estimate = Estimate::of(&fix(0, 0, 16_384, 0), Angle(0));
        estimate.covariance.hh = (182.04 * RADIANS).powi(2);
        let to = Pose { x: Millimetres(10_000), ..Pose::default() };
        estimate.drive(Pose::default(), to, 1.0, &noise);
        let Covariance { xx, yy, .. } = estimate.covariance;
        assert!((xx.sqrt() - 174.5).abs() < 0.1 && yy < 2.0, "{xx} {yy}");
    }

    #[test]
    fn reach_limits_the_lateral_error_to_one_cell() {
        let reach = |degrees: f32| {
            let heading = degrees.to_radians().powi(2);
            Variances { position: 0.0, heading }.reach(Millimetres(50), 4_000)
        };
        // 50 mm are 1 degree at 2.865 m, and 0.716 degrees at 4 m.
        assert_eq!([0.0, 0.7, 0.72].map(reach), [4_000, 4_000, 3_978]);
        assert_eq!([1.0, 3.0, 60.0].map(reach), [2_864, 954, 47]);
    }
}
