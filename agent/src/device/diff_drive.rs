//! Two driven wheels: from encoder counts to odometry, and from a command to wheel speeds.

use ubimap_protocol::units::{Angle, Millimetres, Pose};

use crate::{drive::DriveCommand, trigonometry::sin_cos};

/// Fractional bits of lengths.
const FRACTION: u32 = 20;

/// The geometry and the limits of a base with two driven wheels.
///
/// All values are integers, so that a constant needs no arithmetic at run time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WheelBase {
    /// Distance covered per encoder count, in nanometres; negative if the encoders count backwards.
    pub count_nm: i32,
    /// Distance between the wheels' points of contact, in micrometres.
    pub track_um: u32,
    /// Maximum speed of a wheel, in mm/s.
    pub top_speed: u16,
    /// Maximum change of a wheel's speed in a second, in mm/s: what the motors can follow.
    pub slew: u16,
}

impl WheelBase {
    /// The iRobot Create 2: wheels of 72 mm, 508.8 counts per turn, 235 mm apart, up to 500 mm/s.
    pub const CREATE2: Self =
        Self { count_nm: 444_565, track_um: 235_000, top_speed: 500, slew: 1_500 };
}

/// The odometry of two driven wheels: `base_link`, the middle between the wheels, in `odom`.
#[derive(Clone, Copy, Debug)]
pub struct DiffDrive {
    base: WheelBase,
    /// Position in 2^-20 mm.
    x: i64,
    y: i64,
    /// Heading in 2^-32 turns.
    heading: u32,
}

impl DiffDrive {
    /// At the origin of `odom`.
    pub const fn new(base: WheelBase) -> Self {
        Self { base, x: 0, y: 0, heading: 0 }
    }

    /// Adds the numbers of counts of the left and the right wheel since the last call. The base
    /// drives along an arc of constant curvature, whose chord has the direction of its middle.
    ///
    /// The position is rounded to 2^-20 mm and the heading to 2^-32 turns per call.
    pub fn advance(&mut self, [left, right]: [i32; 2]) {
        let (left, right) = (i64::from(left), i64::from(right));
        let (count_nm, track_um) = (i64::from(self.base.count_nm), i64::from(self.base.track_um));
        // The angle is the difference of the ways divided by the track; 2^32 / (2 pi) * 1e-3 =
        // 683,565,275.576 / 1000 units per nanometre and micrometre.
        let difference = (right - left).saturating_mul(count_nm);
        let turn = i128::from(difference) * 683_565_276 / (i128::from(track_um).max(1) * 1_000);
        let turn = turn as i64 as u32 as i32;
        let middle = self.heading.wrapping_add((turn / 2) as u32);
        self.heading = self.heading.wrapping_add(turn as u32);

        let way = (left + right).saturating_mul(count_nm);
        // Half the sum, in 2^-20 mm: a nanometre is 1e-6 mm.
        let way = (i128::from(way) << FRACTION) / 2_000_000;
        let (sin, cos) = sin_cos(middle as i32 as f32 * (core::f32::consts::TAU / 4_294_967_296.0));
        let way = way as i64 as f32;
        self.x = self.x.wrapping_add((way * cos) as i64);
        self.y = self.y.wrapping_add((way * sin) as i64);
    }

    /// `base_link` in `odom`.
    pub fn pose(&self) -> Pose {
        let millimetres = |length: i64| {
            Millimetres((length.wrapping_add(1 << (FRACTION - 1)) >> FRACTION) as i32)
        };
        Pose {
            x: millimetres(self.x),
            y: millimetres(self.y),
            heading: Angle((self.heading.wrapping_add(1 << 15) >> 16) as u16),
        }
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
        let track_um = i64::from(self.base.track_um);
        // mrad/s times micrometres is nm/s; half of it, in mm/s.
        let half = i64::from(command.turn) * track_um / 2_000_000;
        let wanted = [i64::from(command.speed) - half, i64::from(command.speed) + half];
        let fastest = wanted.iter().fold(1, |most, speed| speed.abs().max(most));
        let top = i64::from(self.base.top_speed.min(i16::MAX as u16)).min(fastest);
        let change = i64::from(self.base.slew).saturating_mul(i64::from(elapsed_ms)) / 1_000;
        for (speed, wanted) in self.speeds.iter_mut().zip(wanted) {
            let wanted = wanted * top / fastest.max(1);
            let now = i64::from(*speed);
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
    fn plain(base: WheelBase, steps: &[[i32; 2]]) -> [f64; 3] {
        let (count, track) = (f64::from(base.count_nm) * 1e-6, f64::from(base.track_um) * 1e-3);
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
            let [x, y, heading] = plain(WheelBase::CREATE2, &steps);
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
            let mut drive = DiffDrive::new(WheelBase { count_nm, track_um, ..WheelBase::CREATE2 });
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
