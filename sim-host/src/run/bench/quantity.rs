//! A parameter's value as people write it: its unit, its meaning, and its text.

use ubimap_agent::Parameter;
use ubimap_protocol::{message::ParameterValue, units::Angle};

/// What kind of value a parameter has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Quantity {
    /// A number of this unit.
    Number(&'static str),
    /// An angle: degrees for people, binary angle units on the wire.
    Angle,
    /// Two numbers of 16 bits, with this unit and the value that stands for none, if there is one.
    Pair(&'static str, Option<i32>),
    /// Two bearings, counter-clockwise from the first to the second.
    Bearings,
    /// Whether something is so; it can't be set.
    Truth,
}

/// The value that removes no readings by index or bearing.
const NO_READINGS: i32 = -1;

fn quantity(parameter: Parameter) -> Quantity {
    match parameter {
        Parameter::MountingX | Parameter::MountingY | Parameter::GateDistance => {
            Quantity::Number("mm")
        }
        Parameter::MountingHeading | Parameter::GateTurn => Quantity::Angle,
        Parameter::Hold | Parameter::ScanDeadline => Quantity::Number("ms"),
        Parameter::FirstEpoch => Quantity::Number(""),
        Parameter::Stored => Quantity::Truth,
        Parameter::RemovedPixels => Quantity::Pair("", Some(NO_READINGS)),
        Parameter::RemovedBearings => Quantity::Bearings,
        Parameter::RemovedDistances => Quantity::Pair("mm", Some(0)),
        Parameter::Exposure => Quantity::Pair("", None),
    }
}

/// What a parameter does (SPEC section 6).
pub fn meaning(parameter: Parameter) -> &'static str {
    match parameter {
        Parameter::MountingX => "where the sensor is: ahead of the middle between the wheels",
        Parameter::MountingY => "where the sensor is: to the left of the middle between the wheels",
        Parameter::MountingHeading => "where the sensor looks: counter-clockwise from ahead",
        Parameter::GateDistance => "how far the robot must move before it maps again",
        Parameter::GateTurn => "how far it must turn before it maps again",
        Parameter::Hold => "how long changes of the map are gathered before they are sent",
        Parameter::ScanDeadline => "how long a scan waits for its pose",
        Parameter::FirstEpoch => {
            "lowest epoch of new tiles; a change gives up all that the robot has drawn"
        }
        Parameter::RemovedPixels => "readings never mapped, by index in a scan, first..last",
        Parameter::RemovedBearings => "readings never mapped, by bearing, counter-clockwise",
        Parameter::RemovedDistances => "readings never mapped, by distance",
        Parameter::Exposure => "light in which a depth is valid, darkest..brightest",
        Parameter::Stored => "whether the robot's next boot begins with these values",
    }
}

/// The unit in which people give a parameter; empty for a number without one.
pub fn unit(parameter: Parameter) -> &'static str {
    match quantity(parameter) {
        Quantity::Number(unit) | Quantity::Pair(unit, _) => unit,
        Quantity::Angle | Quantity::Bearings => "degrees",
        Quantity::Truth => "",
    }
}

/// The range of a parameter in its unit.
pub fn range(parameter: Parameter) -> String {
    let (least, most) = parameter.range();
    match quantity(parameter) {
        Quantity::Number(_) => format!("{least} to {most}"),
        Quantity::Angle => format!("{:.0} to {:.0}", degrees(least), degrees(most)),
        Quantity::Pair(_, None) => "A..B, each 0 to 65535".into(),
        Quantity::Pair(..) => "A..B, each 0 to 65535, or none".into(),
        Quantity::Bearings => "A..B, each -360 to 360, or none".into(),
        Quantity::Truth => "yes or no; ubimap param store makes it yes".into(),
    }
}

/// A value in the parameter's unit, without the unit.
pub fn shown(parameter: Parameter, value: i32) -> String {
    let (upper, lower) = halves(value);
    match quantity(parameter) {
        Quantity::Number(_) => value.to_string(),
        Quantity::Angle if parameter == Parameter::MountingHeading => signed(Angle(value as u16)),
        Quantity::Angle => format!("{:.2}", degrees(value)),
        Quantity::Pair(_, none) if none == Some(value) => "none".into(),
        Quantity::Pair(..) => format!("{upper}..{lower}"),
        Quantity::Bearings if value == NO_READINGS => "none".into(),
        Quantity::Bearings => format!("{}..{}", signed(Angle(upper)), signed(Angle(lower))),
        Quantity::Truth => if value == 0 { "no" } else { "yes" }.into(),
    }
}

/// The value that a text in the parameter's unit stands for.
///
/// # Errors
/// What is expected, in one line.
pub fn parsed(parameter: Parameter, text: &str) -> Result<i32, String> {
    let (least, most) = parameter.range();
    let expected = || {
        let (name, range, unit) = (parameter.name(), range(parameter), unit(parameter));
        format!("{text:?} is not a value of {name}: {range} {unit}").trim_end().to_owned()
    };
    let within = |value: i32| (least..=most).contains(&value).then_some(value);
    let halves = || text.split_once("..");
    let binary = |text: &str| {
        let degrees: f64 = text.trim().parse().ok()?;
        (degrees.abs() <= 360.0).then(|| Angle::from_degrees(degrees).0)
    };
    let joined = |(from, to): (u16, u16)| (u32::from(from) << 16 | u32::from(to)) as i32;
    let value = match quantity(parameter) {
        Quantity::Number(_) => text.parse().ok().and_then(within),
        Quantity::Angle => {
            let units = text.parse::<f64>().ok().map(|degrees| degrees * 65_536.0 / 360.0);
            // Conversions of floats saturate; what is not a number is not within.
            units.filter(|it| it.is_finite()).and_then(|units| within(units.round() as i32))
        }
        Quantity::Pair(_, none @ Some(_)) if text == "none" => none,
        Quantity::Pair(..) => halves().and_then(|(from, to)| {
            Some(joined((from.trim().parse().ok()?, to.trim().parse().ok()?)))
        }),
        Quantity::Bearings if text == "none" => Some(NO_READINGS),
        Quantity::Bearings => {
            halves().and_then(|(from, to)| Some(joined((binary(from)?, binary(to)?))))
        }
        Quantity::Truth => {
            return Err(format!("{} can't be set: see ubimap param store", parameter.name()));
        }
    };
    value.ok_or_else(expected)
}

/// The parameter with a name.
///
/// # Errors
/// The names that there are, in one line.
pub fn named(name: &str) -> Result<Parameter, String> {
    let wanted = name.replace('_', "-");
    let found = Parameter::ALL.iter().find(|it| it.name() == wanted);
    found.copied().ok_or_else(|| {
        let names: Vec<_> = Parameter::ALL.iter().map(|it| it.name()).collect();
        format!("there is no parameter {name:?}; there are {}", names.join(", "))
    })
}

/// A parameter that a robot can have from its start, by its name and its value on the wire.
///
/// # Errors
/// What is expected, in one line.
pub fn on_wire(name: &str, value: &str) -> Result<ParameterValue, String> {
    let parameter = named(name)?;
    if parameter == Parameter::Stored {
        return Err("it says of a running robot whether its parameters are stored".into());
    }
    let (least, most) = parameter.range();
    let value = value.trim().parse().ok().filter(|value| (least..=most).contains(value));
    let value =
        value.ok_or_else(|| format!("the value must be a whole number from {least} to {most}"))?;
    Ok(ParameterValue { parameter: parameter as u16, value })
}

/// The upper and the lower half of a value.
fn halves(value: i32) -> (u16, u16) {
    ((value >> 16) as u16, value as u16)
}

fn degrees(units: i32) -> f64 {
    f64::from(units) * 360.0 / 65_536.0
}

/// An angle between -180 and 180 degrees.
fn signed(angle: Angle) -> String {
    format!("{:.2}", degrees(i32::from(angle.0 as i16)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_is_read_as_it_is_shown() {
        for &parameter in Parameter::ALL {
            if parameter == Parameter::Stored {
                assert_eq!([0, 1].map(|value| shown(parameter, value)), ["no", "yes"]);
                assert!(parsed(parameter, "yes").unwrap_err().contains("param store"));
                continue;
            }
            let (least, most) = parameter.range();
            for value in [least, most, most / 3, least / 7, 0, NO_READINGS, 0x0012_0345] {
                if !(least..=most).contains(&value) {
                    continue;
                }
                let text = shown(parameter, value);
                let read = parsed(parameter, &text).unwrap_or_else(|error| panic!("{error}"));
                // Two digits of a degree do not tell neighbouring binary angles apart.
                let near = |a: u16, b: u16| (a.wrapping_sub(b) as i16).unsigned_abs() <= 1;
                let (read, value) = (halves(read), halves(value));
                let whole = matches!(quantity(parameter), Quantity::Number(_) | Quantity::Pair(..));
                let is_same = match quantity(parameter) {
                    Quantity::Angle => near(read.1, value.1),
                    _ => near(read.0, value.0) && near(read.1, value.1),
                };
                assert!(if whole { read == value } else { is_same }, "{parameter:?}: {text}");
            }
            assert!(!meaning(parameter).is_empty() && !range(parameter).is_empty());
            assert_eq!(named(parameter.name()), Ok(parameter));
        }
    }

    #[test]
    fn values_in_other_units_or_out_of_range_are_refused_with_what_is_expected() {
        for (parameter, text, told) in [
            (Parameter::MountingX, "2001", "-2000 to 2000 mm"),
            (Parameter::MountingX, "10 cm", "-2000 to 2000 mm"),
            (Parameter::Hold, "-1", "0 to 60000 ms"),
            (Parameter::GateTurn, "180", "0 to 180 degrees"),
            (Parameter::GateTurn, "nan", "degrees"),
            (Parameter::RemovedPixels, "7", "A..B"),
            (Parameter::RemovedPixels, "7..65536", "65535"),
            (Parameter::RemovedBearings, "10..1e9", "-360 to 360"),
            (Parameter::Exposure, "none", "A..B"),
        ] {
            let error = parsed(parameter, text).unwrap_err();
            assert!(error.contains(told) && error.contains(parameter.name()), "{error}");
        }
        assert!(named("speed").unwrap_err().contains("mounting-x, mounting-y"));
        assert_eq!(named("gate_turn"), Ok(Parameter::GateTurn));
        assert_eq!(parsed(Parameter::MountingHeading, "-90"), Ok(-16_384));
        assert_eq!(parsed(Parameter::RemovedBearings, "-90..90"), Ok(0xC000_4000_u32 as i32));
    }
}
