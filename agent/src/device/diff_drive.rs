//! Two driven wheels: from encoder counts to odometry, and from a command to wheel speeds.

use core::f32::consts::TAU;

use ubimap_protocol::units::{Angle, Millimetres, Pose};

use crate::{drive::DriveCommand, trigonometry::sin_cos};

/// The geometry and the limits of a base with two driven wheels.
///
/// All values are integers, and what follows from them is computed when a constant is compiled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WheelBase {
    /// Distance between the wheels' points of contact, in micrometres.
    track_um: u32,
    /// Half the distance covered per encoder count, in 2^-32 mm.
    half_count: i64,
    /// The angle turned per count of difference between the wheels, in 2^-64 turns.
    turn: i64,
    /// Maximum speed of a wheel, in mm/s.
    top_speed: u16,
    /// Maximum acceleration of a wheel, in mm/s^2.
    slew: u16,
}

impl WheelBase {
    /// The iRobot Create 2: wheels of 72 mm, 508.8 counts per turn, 235 mm apart, up to 500 mm/s.
    pub const CREATE2: Self = Self::new(444_565, 235_000, 500, 1_500);

    /// A base whose wheels cover `count_nm` nanometres per encoder count (negative if the encoders
    /// count backwards) and stand `track_um` micrometres apart, at most a metre. The wheels reach
    /// `top_speed` mm/s and accelerate by `slew` mm/s^2 at most. Call it in a constant: it divides
    /// 128-bit integers.
    pub const fn new(count_nm: i32, track_um: u32, top_speed: u16, slew: u16) -> Self {
        let count = count_nm as i128;
        let track = if track_um == 0 { 1 } else { track_um as i128 };
        // The angle is the difference of the ways divided by the track; 2 pi is 6,283,185,307 nm/m.
        let turn = (count << 64) * 1_000_000 / (track * 6_283_185_307);
        Self {
            track_um,
            half_count: ((count << 32) / 2_000_000) as i64,
            turn: turn as i64,
            top_speed,
            slew,
        }
    }

    /// Maximum speed of a wheel, in mm/s.
    pub const fn top_speed(&self) -> u16 {
        self.top_speed
    }

    /// The way of a wheel in micrometres for this number of counts, at most 2 km either way.
    pub const fn way_um(&self, counts: i32) -> i32 {
        // Half a count in 2^-32 mm, in micrometres: times 2,000, in 2^-32.
        let way = (self.half_count as i128 * counts as i128 * 2_000) >> 32;
        if way > i32::MAX as i128 {
            i32::MAX
        } else if way < i32::MIN as i128 {
            i32::MIN
        } else {
            way as i32
        }
    }
}

/// The odometry of two driven wheels: `base_link`, the middle between the wheels, in `odom`.
#[derive(Clone, Copy, Debug)]
pub struct DiffDrive {
    base: WheelBase,
    /// Position in 2^-32 mm.
    x: i64,
    y: i64,
    /// Heading in 2^-64 turns.
    heading: u64,
}

impl DiffDrive {
    /// At the origin of `odom`.
    pub const fn new(base: WheelBase) -> Self {
        Self { base, x: 0, y: 0, heading: 0 }
    }

    /// Adds the numbers of counts of the left and the right wheel since the last call. The base
    /// drives along an arc of constant curvature, whose chord has the direction of its middle. The
    /// chord is rounded to single precision.
    pub fn advance(&mut self, [left, right]: [i32; 2]) {
        let (left, right) = (i64::from(left), i64::from(right));
        let turn = (right - left).wrapping_mul(self.base.turn);
        let middle = self.heading.wrapping_add((turn / 2) as u64);
        self.heading = self.heading.wrapping_add(turn as u64);
        let middle = (middle >> 32) as i32 as f32 * (TAU / 4_294_967_296.0);
        let (sin, cos) = sin_cos(middle);
        let way = (left + right).wrapping_mul(self.base.half_count) as f32;
        self.x = self.x.wrapping_add((way * cos) as i64);
        self.y = self.y.wrapping_add((way * sin) as i64);
    }

    /// `base_link` in `odom`.
    pub fn pose(&self) -> Pose {
        let millimetres = |length: i64| Millimetres((length.wrapping_add(1 << 31) >> 32) as i32);
        let heading = Angle((self.heading.wrapping_add(1 << 47) >> 48) as u16);
        Pose { x: millimetres(self.x), y: millimetres(self.y), heading }
    }
}

/// The speeds of the left and the right wheel in mm/s, limited in speed and in acceleration.
#[derive(Clone, Copy, Debug)]
pub struct WheelSpeeds {
    base: WheelBase,
    speeds: [i16; 2],
}

impl WheelSpeeds {
    /// Standing wheels.
    pub const fn new(base: WheelBase) -> Self {
        Self { base, speeds: [0; 2] }
    }

    /// The speeds for a command, given `elapsed_ms` after the last ones. A wheel that is too fast
    /// slows both down, so that the curvature stays. A stop is not limited: braking distances
    /// assume that it begins at once.
    pub fn follow(&mut self, command: DriveCommand, elapsed_ms: u32) -> [i16; 2] {
        if command == DriveCommand::STAND {
            self.speeds = [0; 2];
            return self.speeds;
        }
        // At most a metre: mrad/s times tenths of a millimetre, in mm/s, for half the track.
        let track = (self.base.track_um.min(1_000_000) / 100) as i32;
        let half = i32::from(command.turn) * track / 20_000;
        let wanted = [i32::from(command.speed) - half, i32::from(command.speed) + half];
        let fastest = wanted.iter().fold(1, |most, speed| speed.abs().max(most));
        let top = i32::from(self.base.top_speed.min(i16::MAX as u16)).min(fastest);
        let change = i32::from(self.base.slew) * elapsed_ms.min(1_000) as i32 / 1_000;
        for (speed, wanted) in self.speeds.iter_mut().zip(wanted) {
            let wanted = wanted * top / fastest.max(1);
            let now = i32::from(*speed);
            *speed = wanted.clamp(now - change, now + change) as i16;
        }
        self.speeds
    }

    /// The speeds last returned.
    pub fn speeds(&self) -> [i16; 2] {
        self.speeds
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    /// The plain way: the arcs in double precision.
    fn plain(steps: &[[i32; 2]]) -> [f64; 3] {
        let (count, track) = (0.444_565, 235.0);
        steps.iter().fold([0.0; 3], |[x, y, heading], &[left, right]| {
            let (left, right) = (f64::from(left) * count, f64::from(right) * count);
            let turn = (right - left) / track;
            let (way, middle) = ((left + right) / 2.0, heading + turn / 2.0);
            [x + way * middle.cos(), y + way * middle.sin(), heading + turn]
        })
    }

    proptest! {
        /// Ten minutes at 66 Hz: the integers stay within 1 mm and a sixteenth of a degree.
        #[test]
        fn odometry_is_that_of_double_precision(
            legs in prop::collection::vec((-15i32..15, -15i32..15, 1usize..400), 1..100),
        ) {
            let steps: Vec<_> =
                legs.iter().flat_map(|&(left, right, steps)| std::iter::repeat_n([left, right], steps)).collect();
            let mut drive = DiffDrive::new(WheelBase::CREATE2);
            steps.iter().for_each(|&step| drive.advance(step));
            let [x, y, heading] = plain(&steps);
            let pose = drive.pose();
            prop_assert!((f64::from(pose.x.0) - x).abs() < 1.0, "{pose:?}: {x}");
            prop_assert!((f64::from(pose.y.0) - y).abs() < 1.0, "{pose:?}: {y}");
            prop_assert!(pose.heading.distance(Angle::from_radians(heading)) < 12, "{pose:?}: {heading}");
        }

        /// Any counts and geometries: no panic.
        #[test]
        fn any_counts_are_taken(
            steps in prop::collection::vec(any::<[i32; 2]>(), 0..20),
            count_nm: i32, track_um: u32,
        ) {
            let mut drive = DiffDrive::new(WheelBase::new(count_nm, track_um, 500, 1_500));
            steps.into_iter().for_each(|step| drive.advance(step));
            drive.pose();
        }

        /// Speeds keep to the limits and reach what the command asks for, if the wheels can.
        #[test]
        fn speeds_follow_the_command_within_the_limits(
            speed in -600i16..600, turn in -3_000i16..3_000, elapsed in 1u32..100,
        ) {
            let base = WheelBase::CREATE2;
            let mut wheels = WheelSpeeds::new(base);
            let mut before = [0; 2];
            let command = DriveCommand { speed, turn };
            for _ in 0..1_000 {
                let now = wheels.follow(command, elapsed);
                for (now, before) in now.into_iter().zip(before) {
                    prop_assert!(now.unsigned_abs() <= base.top_speed);
                    let most = u32::from(base.slew) * elapsed / 1_000;
                    prop_assert!(u32::from(now.abs_diff(before)) <= most);
                }
                before = now;
            }
            let [left, right] = before.map(f64::from);
            let wanted = [f64::from(speed), f64::from(turn) * 0.235];
            let [forward, difference] = [(left + right) / 2.0, right - left];
            let fastest = wanted[0].abs() + wanted[1].abs() / 2.0;
            let part = (500.0 / fastest.max(1.0)).min(1.0);
            if u32::from(base.slew) * elapsed >= 1_000 {
                prop_assert!((forward - wanted[0] * part).abs() <= 2.0, "{before:?}");
                prop_assert!((difference - wanted[1] * part).abs() <= 3.0, "{before:?}");
            }
            prop_assert_eq!(wheels.follow(DriveCommand::STAND, elapsed), [0, 0]);
        }
    }

    #[test]
    fn a_wheel_turn_covers_its_circumference() {
        let mut drive = DiffDrive::new(WheelBase::CREATE2);
        drive.advance([5_088, 5_088]);
        assert_eq!(drive.pose(), Pose { x: Millimetres(2_262), ..Pose::default() });
        // A full turn on the spot: each wheel drives pi times 235 mm, which is 1,660.7 counts.
        drive.advance([-1_661, 1_661]);
        assert!(drive.pose().heading.distance(Angle(0)) < 20, "{:?}", drive.pose());
    }
}
