//! What is wrong with a robot of the rig: how it was built, or what it carries.

use std::str::FromStr;

use crate::{
    devices::Wiring,
    world::{RobotConfig, Scenario},
};

/// A fault, and the number of the robot that has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fault {
    robot: u16,
    cause: Cause,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Cause {
    /// This motor's wires are swapped: it turns backwards, and its encoder says so.
    Motor(usize),
    /// This encoder's wires are swapped: it counts backwards.
    Encoder(usize),
    /// Each motor gets the other one's commands.
    SwappedMotors,
    /// Each encoder is read as the other one.
    SwappedEncoders,
    /// Counts for each count of a good encoder.
    Ticks(f64),
    /// The sensor looks down, in degrees.
    Tilt(f64),
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected = || {
            "give ROBOT:FAULT; the faults are left-motor, right-motor, left-encoder, right-encoder, swapped-motors, \
             swapped-encoders, ticks=1.03 and tilt=4"
                .to_owned()
        };
        let (robot, cause) = text.split_once(':').ok_or_else(expected)?;
        let robot = robot.parse().map_err(|_| expected())?;
        let (name, value) = cause.split_once('=').unwrap_or((cause, ""));
        let number = |least: f64, most: f64| match value.parse::<f64>() {
            Ok(number) if (least..=most).contains(&number) => Ok(number),
            _ => Err(format!("{name} must be from {least} to {most}")),
        };
        let cause = match (name, value) {
            ("left-motor", "") => Cause::Motor(0),
            ("right-motor", "") => Cause::Motor(1),
            ("left-encoder", "") => Cause::Encoder(0),
            ("right-encoder", "") => Cause::Encoder(1),
            ("swapped-motors", "") => Cause::SwappedMotors,
            ("swapped-encoders", "") => Cause::SwappedEncoders,
            ("ticks", _) => Cause::Ticks(number(0.5, 2.0)?),
            ("tilt", _) => Cause::Tilt(number(-45.0, 45.0)?),
            _ => return Err(expected()),
        };
        Ok(Self { robot, cause })
    }
}

impl Fault {
    /// The robot.
    pub(super) fn robot(self) -> u16 {
        self.robot
    }
}

/// Tilts the sensors of the robots that have such a fault.
pub(super) fn tilt(faults: &[Fault], robot: &mut RobotConfig) {
    for fault in faults.iter().filter(|fault| fault.robot == robot.id) {
        if let Cause::Tilt(degrees) = fault.cause {
            robot.sensor.tilt_deg = degrees;
        }
    }
}

/// The wiring of a robot's base.
pub(super) fn wiring(faults: &[Fault], robot: u16) -> Wiring {
    let mut wiring = Wiring::default();
    for fault in faults.iter().filter(|fault| fault.robot == robot) {
        match fault.cause {
            Cause::Motor(wheel) => wiring.motors[wheel] *= -1.0,
            Cause::Encoder(wheel) => wiring.encoders[wheel] *= -1.0,
            Cause::SwappedMotors => wiring.swapped_motors = true,
            Cause::SwappedEncoders => wiring.swapped_encoders = true,
            Cause::Ticks(ratio) => wiring.encoders = wiring.encoders.map(|it| it * ratio),
            Cause::Tilt(_) => {}
        }
    }
    wiring
}

/// The robots that are named and not there.
pub(super) fn missing(scenario: &Scenario, named: impl Iterator<Item = u16>) -> Option<u16> {
    named.into_iter().find(|robot| scenario.robots.iter().all(|it| it.id != *robot))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_are_read_and_add_up() {
        let read = |text: &str| text.parse::<Fault>();
        let faults: Vec<Fault> =
            ["1:left-motor", "1:ticks=1.03", "2:swapped-motors", "1:right-encoder"]
                .map(|text| read(text).unwrap())
                .into();
        let first = Wiring { motors: [-1.0, 1.0], encoders: [1.03, -1.03], ..Wiring::default() };
        assert_eq!(wiring(&faults, 1), first);
        assert_eq!(wiring(&faults, 2), Wiring { swapped_motors: true, ..Wiring::default() });
        assert_eq!(wiring(&faults, 3), Wiring::default());
        for (text, told) in [
            ("left-motor", "give ROBOT:FAULT"),
            ("x:left-motor", "give ROBOT:FAULT"),
            ("1:left-motor=2", "give ROBOT:FAULT"),
            ("1:wheel", "swapped-motors"),
            ("1:ticks", "from 0.5 to 2"),
            ("1:tilt=nan", "from -45 to 45"),
        ] {
            let error = read(text).unwrap_err();
            assert!(error.contains(told), "{text}: {error}");
        }
    }
}
