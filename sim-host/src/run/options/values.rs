//! The values of options: numbers with units, within bounds.

use clap::value_parser;
use ubimap_protocol::{
    time::Duration,
    units::{Millimetres, Pose},
};

use crate::recording::units_per_metre;

/// Why the value of an option is invalid.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub(in crate::run) enum OptionError {
    #[error("not a number")]
    NotANumber,
    #[error("must be from {least} to {most} {unit}")]
    OutOfRange { least: f64, most: f64, unit: &'static str },
    #[error("must be whole millimetres")]
    FractionOfMillimetre,
    #[error("must be X,Y,DEG: metres, metres, degrees")]
    NotAPose,
    #[error("must be LOW,HIGH: two heights in metres, the lower one first")]
    NotHeights,
}

pub(super) fn robots() -> clap::builder::RangedI64ValueParser<u16> {
    value_parser!(u16).range(1..=1_000)
}

/// A number within bounds.
pub(in crate::run) fn number(
    text: &str,
    least: f64,
    most: f64,
    unit: &'static str,
) -> Result<f64, OptionError> {
    let value: f64 = text.parse().map_err(|_| OptionError::NotANumber)?;
    if (least..=most).contains(&value) {
        Ok(value)
    } else {
        Err(OptionError::OutOfRange { least, most, unit })
    }
}

pub(super) fn probability(text: &str) -> Result<f64, OptionError> {
    number(text, 0.0, 1.0, "(a probability)")
}

pub(in crate::run) fn resolution(text: &str) -> Result<Millimetres, OptionError> {
    let metres = number(text, 0.02, 1.0, "m")?;
    if ((metres * 1000.0).round() - metres * 1000.0).abs() > 1e-6 {
        return Err(OptionError::FractionOfMillimetre);
    }
    Ok(Millimetres::from_metres(metres))
}

/// Two heights, the lower one first, in whole millimetres.
pub(in crate::run) fn heights(text: &str) -> Result<[Millimetres; 2], OptionError> {
    let (low, high) = text.split_once(',').ok_or(OptionError::NotHeights)?;
    let height = |text: &str| {
        number(text.trim(), 0.005, 10.0, "m")
            .map(|metres| Millimetres((metres * 1000.0).round() as i32))
    };
    let heights = [height(low)?, height(high)?];
    if heights[0] < heights[1] { Ok(heights) } else { Err(OptionError::NotHeights) }
}

pub(super) fn max_range(text: &str) -> Result<Millimetres, OptionError> {
    number(text, 0.1, 65.0, "m").map(Millimetres::from_metres)
}

/// Units per metre, from that or from the length of a unit in metres.
pub(super) fn depth_scale(text: &str) -> Result<f64, OptionError> {
    number(text, 1e-6, 1e6, "units in a metre, or metres in a unit").map(units_per_metre)
}

pub(super) fn tolerance(text: &str) -> Result<f64, OptionError> {
    number(text, 0.0, 1e6, "m")
}

pub(in crate::run) fn pose(text: &str) -> Result<Pose, OptionError> {
    let parts: Vec<&str> = text.split(',').map(str::trim).collect();
    let [x, y, heading] = parts[..] else { return Err(OptionError::NotAPose) };
    let metres = |text| number(text, -10_000.0, 10_000.0, "m");
    let degrees = number(heading, -360.0, 360.0, "degrees")?;
    Ok(Pose::from_metres(metres(x)?, metres(y)?, degrees.to_radians()))
}

pub(in crate::run) fn seconds(text: &str) -> Result<Duration, OptionError> {
    let seconds = number(text, 0.1, 1e6, "s")?;
    Ok(Duration::from_micros((seconds * 1e6).round() as u64))
}

pub(in crate::run) fn milliseconds(text: &str) -> Result<Duration, OptionError> {
    let milliseconds = number(text, 0.0, 60_000.0, "ms")?;
    Ok(Duration::from_micros((milliseconds * 1e3).round() as u64))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    #[test]
    fn values_are_checked() {
        assert_eq!(probability("0.3"), Ok(0.3));
        assert!(
            ["-0.1", "1.1", "nan", "inf", "x", ""].iter().all(|text| probability(text).is_err())
        );
        assert_eq!(resolution("0.05"), Ok(Millimetres(50)));
        assert_eq!(resolution("0.029"), Ok(Millimetres(29)));
        assert_eq!(resolution("0.0505"), Err(OptionError::FractionOfMillimetre));
        assert!(resolution("0").is_err() && max_range("-4").is_err());
        assert_eq!(heights("0.03, 0.4"), Ok([Millimetres(30), Millimetres(400)]));
        assert_eq!(heights("0.4,0.03"), Err(OptionError::NotHeights));
        assert_eq!(heights("0.4"), Err(OptionError::NotHeights));
        assert!(heights("0,0.4").is_err() && heights("0.1,x").is_err());
        assert_eq!(depth_scale("5000"), Ok(5000.0));
        assert!((depth_scale("0.001").unwrap() - 1000.0).abs() < 1e-9);
        assert!(depth_scale("0").is_err() && depth_scale("-1").is_err());
        assert_eq!(milliseconds("0.25"), Ok(Duration::from_micros(250)));
        assert_eq!(pose("-1.5, 2,90"), Ok(Pose::from_metres(-1.5, 2.0, FRAC_PI_2)));
        assert_eq!(pose("1,2"), Err(OptionError::NotAPose));
        assert_eq!(pose("1,2,x"), Err(OptionError::NotANumber));
        assert!(pose("1,inf,0").is_err() && pose("1,2,400").is_err());
    }
}
