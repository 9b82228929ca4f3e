//! Sine and cosine in single precision. `libm`'s functions use double precision internally, which a
//! Cortex-M4 has to emulate: 7 KiB of flash and 2,400 instructions per call.

use core::f32::consts::{FRAC_PI_2, PI, TAU};

use ubimap_protocol::units::Angle;

/// Radians per binary angle unit.
pub(crate) const RADIANS: f32 = TAU / 65_536.0;

/// Sine and cosine of an angle in radians, with an error below 4e-7 within ten turns.
pub(crate) fn sin_cos(radians: f32) -> (f32, f32) {
    // A quarter turn as the sum of two constants, so that the remainder is precise.
    const HIGH: f32 = 1.570_312_5;
    const LOW: f32 = 4.838_268e-4;
    let quarters = libm::rintf(radians / FRAC_PI_2);
    let rest = (radians - quarters * HIGH) - quarters * LOW;
    // Taylor polynomials; the angle is within an eighth of a turn of zero.
    let square = rest * rest;
    let sine = 1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5_040.0));
    let sine = rest - rest * square * sine;
    let cosine = 1.0 / 24.0 - square * (1.0 / 720.0 - square * (1.0 / 40_320.0));
    let cosine = 1.0 - square * (0.5 - square * cosine);
    match quarters as i32 & 3 {
        0 => (sine, cosine),
        1 => (cosine, -sine),
        2 => (-sine, -cosine),
        _ => (-cosine, sine),
    }
}

/// The nearest integer. Not inlined, so that the firmware contains it once.
#[inline(never)]
pub(crate) fn round(value: f32) -> f32 {
    libm::roundf(value)
}

/// A binary angle converted to radians, in [-pi, pi).
pub(crate) fn radians(angle: Angle) -> f32 {
    f32::from(angle.0 as i16) * (PI / 32_768.0)
}

/// The nearest binary angle to an angle in radians, which must be below a hundred turns.
pub(crate) fn angle(radians: f32) -> Angle {
    Angle(round(radians * (32_768.0 / PI)) as i32 as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sine_and_cosine_are_accurate() {
        for step in -7_000i32..7_000 {
            let radians = step as f32 * 0.009;
            let (sine, cosine) = sin_cos(radians);
            let (right_sine, right_cosine) = libm::sincos(f64::from(radians));
            assert!((f64::from(sine) - right_sine).abs() < 4e-7, "{radians}: {sine}");
            assert!((f64::from(cosine) - right_cosine).abs() < 4e-7, "{radians}: {cosine}");
        }
        for units in 0..=u16::MAX {
            assert_eq!(angle(radians(Angle(units))), Angle(units));
        }
    }
}
