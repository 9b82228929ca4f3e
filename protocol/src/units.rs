//! Quantities on the wire: integer millimetres and binary angles (ROS REP-103 axes).

use core::ops::{Add, Neg, Sub};

use serde::{Deserialize, Serialize};

/// A length or a coordinate in whole millimetres; plus or minus 2,147 km.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Millimetres(pub i32);

impl Millimetres {
    /// Rounds a length in metres to the nearest millimetre; saturates, and NaN gives zero.
    pub fn from_metres(metres: f64) -> Self {
        // Rounds half away from zero; `f64::round` needs `std`.
        let scaled = metres * 1000.0;
        Self((scaled + if scaled < 0.0 { -0.5 } else { 0.5 }) as i32)
    }

    /// The length in metres.
    pub fn metres(self) -> f64 {
        f64::from(self.0) / 1000.0
    }
}

impl Add for Millimetres {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0.wrapping_add(other.0))
    }
}

impl Sub for Millimetres {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0.wrapping_sub(other.0))
    }
}

/// A binary angle: 65,536 units are a full turn (0.0055 degrees each), counter-clockwise from x.
/// Arithmetic wraps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Angle(pub u16);

impl Angle {
    /// Rounds an angle in radians (any number of turns) to the nearest binary angle; NaN gives
    /// zero.
    pub fn from_radians(radians: f64) -> Self {
        let turns = radians * (65_536.0 / core::f64::consts::TAU);
        let rounded = turns + if turns < 0.0 { -0.5 } else { 0.5 };
        Self(rounded as i64 as u16)
    }

    /// Rounds an angle in degrees (any number of turns) to the nearest binary angle.
    pub fn from_degrees(degrees: f64) -> Self {
        Self::from_radians(degrees.to_radians())
    }

    /// The angle in radians, from -pi (inclusive) to pi.
    pub fn radians(self) -> f64 {
        f64::from(self.0 as i16) * (core::f64::consts::TAU / 65_536.0)
    }

    /// The angle in degrees, from -180 (inclusive) to 180.
    pub fn degrees(self) -> f64 {
        self.radians().to_degrees()
    }

    /// The absolute difference between the angles, in binary angle units (0 to 32,768).
    pub fn distance(self, other: Self) -> u16 {
        (self.0.wrapping_sub(other.0) as i16).unsigned_abs()
    }
}

impl Add for Angle {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0.wrapping_add(other.0))
    }
}

impl Sub for Angle {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0.wrapping_sub(other.0))
    }
}

impl Neg for Angle {
    type Output = Self;
    fn neg(self) -> Self {
        Self(self.0.wrapping_neg())
    }
}

/// A pose in the plane: the position and heading of one frame (`base_link`, a sensor) in another
/// (`map`, `odom`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Pose {
    /// Forward, along the x axis of the outer frame.
    pub x: Millimetres,
    /// Left, along the y axis of the outer frame.
    pub y: Millimetres,
    /// Counter-clockwise from the x axis of the outer frame.
    pub heading: Angle,
}

impl Pose {
    /// A pose from metres and radians (counter-clockwise).
    pub fn from_metres(x: f64, y: f64, heading_radians: f64) -> Self {
        Self {
            x: Millimetres::from_metres(x),
            y: Millimetres::from_metres(y),
            heading: Angle::from_radians(heading_radians),
        }
    }
}

/// The number of a robot, unique in a deployment.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct RobotId(pub u16);

/// The number of a session, chosen by the server. Zero means no session, as in handshake frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct SessionId(pub u32);

impl SessionId {
    /// Stands for no session; used in handshake frames.
    pub const NONE: Self = Self(0);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_round_to_the_nearest_millimetre_and_saturate() {
        assert_eq!(Millimetres::from_metres(0.0016), Millimetres(2));
        assert_eq!(Millimetres::from_metres(-0.0016), Millimetres(-2));
        assert_eq!(Millimetres::from_metres(1e12), Millimetres(i32::MAX));
        assert_eq!(Millimetres::from_metres(f64::NAN), Millimetres(0));
    }

    #[test]
    fn angles_wrap() {
        assert_eq!(Angle::from_degrees(90.0), Angle(16_384));
        assert_eq!(Angle::from_degrees(-90.0), Angle(49_152));
        assert_eq!(Angle::from_degrees(270.0), Angle::from_degrees(-90.0));
        assert_eq!(Angle::from_degrees(179.0).distance(Angle::from_degrees(-179.0)), 364);
        assert!((Angle::from_radians(-1.25).radians() + 1.25).abs() < 1e-4);
    }
}
