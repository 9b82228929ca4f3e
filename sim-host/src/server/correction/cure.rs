//! The correction ("cure") of a robot's constant errors, in steps: first its fixes or its sensor's
//! mounting are corrected, then its earlier tiles are retired.

use ubimap_agent::Parameter;
use ubimap_protocol::{
    message::{
        ParameterAction, ParameterCommand, ParameterOutcome, ParameterReport, ParameterValue,
    },
    tile::Epoch,
    time::{Duration, Instant},
    units::Angle,
};

use crate::{mapping::ConstantErrors, server::command::FIRST_OWN_NUMBER};

/// Time for a robot's filter to follow a correction of its fixes.
const SETTLING: Duration = Duration::from_secs(3);
/// Margin for epochs that a robot has used without the server's knowledge: the robot starts an
/// epoch whenever a tile leaves its pool.
const EPOCHS_AHEAD: u32 = 4_096;
/// Maximum first epoch that a robot is given.
const LAST_EPOCH: u32 = 1 << 30;

/// The state of a cure.
#[derive(Debug, Default)]
pub(super) enum Cure {
    #[default]
    None,
    /// The server was restarted before the robot's older epochs were retired.
    LeftOff,
    /// Fixes are corrected; the robot's older epochs are retired once its filter has followed the
    /// correction.
    Settling(Instant),
    /// The sensor's error is known; `turn` must be added to its mounting.
    Found { turn: Angle },
    /// The robot was asked for its sensor's mounting.
    Asking { number: u16, turn: Angle },
    /// The new mounting was sent to the robot.
    Mounting { number: u16, turn: Angle },
    /// The robot was told to restart its tiles.
    Retiring { number: u16, epoch: i32 },
}

/// A step of a cure.
pub(super) enum CureStep {
    /// Send this command to the robot.
    Tell(ParameterCommand),
    /// Fixes are corrected from now on; store the progress.
    IdentifierCorrected,
    /// The sensor's error was found or corrected; store the progress.
    SensorCorrected,
    /// The cure has ended without an effect.
    GiveUp,
    /// The cure is complete: tiles of epochs below this one are void.
    Retire(Epoch),
}

impl Cure {
    /// The first epoch that the robot was told to use, until it answers.
    pub(super) fn retiring(&self) -> Option<Epoch> {
        match *self {
            Self::Retiring { epoch, .. } => Some(Epoch(epoch as u32)),
            _ => None,
        }
    }

    /// The next step, if one is due. `next` is the first epoch after all that the robot is known to
    /// have used.
    pub(super) fn poll(
        &mut self,
        errors: &mut ConstantErrors,
        next: Epoch,
        now: Instant,
    ) -> Option<CureStep> {
        let (number, action) = match *self {
            Self::None if errors.cure_identifier() => {
                *self = Self::Settling(now + SETTLING);
                return Some(CureStep::IdentifierCorrected);
            }
            Self::None => {
                *self = Self::Found { turn: errors.sensor_to_cure()? };
                return Some(CureStep::SensorCorrected);
            }
            Self::LeftOff => {
                *self = Self::Settling(now + SETTLING);
                return None;
            }
            Self::Found { turn } => {
                *self = Self::Asking { number: FIRST_OWN_NUMBER, turn };
                (FIRST_OWN_NUMBER, ParameterAction::Get(Parameter::MountingHeading as u16))
            }
            Self::Settling(until) if until <= now => {
                let number = FIRST_OWN_NUMBER + 2;
                let epoch = next.0.saturating_add(EPOCHS_AHEAD).min(LAST_EPOCH) as i32;
                *self = Self::Retiring { number, epoch };
                (number, set(Parameter::FirstEpoch, epoch))
            }
            _ => return None,
        };
        Some(CureStep::Tell(ParameterCommand { number, action }))
    }

    /// Handles the robot's answer to one of the cure's commands.
    pub(super) fn reported(
        &mut self,
        errors: &mut ConstantErrors,
        report: &ParameterReport,
        now: Instant,
    ) -> Option<CureStep> {
        let value = report.values.first().map(|it| it.value);
        let value = value.filter(|_| report.outcome == ParameterOutcome::Done);
        match *self {
            Self::Asking { number, turn } if number == report.number => {
                let Some(value) = value else { return Some(self.give_up(errors)) };
                let heading = Angle(value as u16) + turn;
                let number = FIRST_OWN_NUMBER + 1;
                *self = Self::Mounting { number, turn };
                let action = set(Parameter::MountingHeading, i32::from(heading.0 as i16));
                Some(CureStep::Tell(ParameterCommand { number, action }))
            }
            Self::Mounting { number, turn } if number == report.number => {
                if value.is_none() {
                    return Some(self.give_up(errors));
                }
                errors.remounted(turn);
                *self = Self::Settling(now);
                Some(CureStep::SensorCorrected)
            }
            Self::Retiring { number, epoch } if number == report.number => {
                *self = Self::None;
                // If the robot reports another epoch, voiding could concern tiles that it will
                // still send.
                (value == Some(epoch)).then_some(CureStep::Retire(Epoch(epoch as u32)))
            }
            _ => None,
        }
    }

    /// Ends the cure after the robot has refused the parameter, and discards the measurements.
    fn give_up(&mut self, errors: &mut ConstantErrors) -> CureStep {
        *self = Self::None;
        errors.remounted(Angle(0));
        CureStep::GiveUp
    }
}

/// An action that sets a parameter.
fn set(parameter: Parameter, value: i32) -> ParameterAction {
    ParameterAction::Set(ParameterValue { parameter: parameter as u16, value })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_epoch_that_the_robot_was_given_is_retired() {
        let retired = |value| {
            let (mut cure, mut errors) = (Cure::Settling(Instant(0)), ConstantErrors::default());
            let step = cure.poll(&mut errors, Epoch(5), Instant(0));
            let Some(CureStep::Tell(command)) = step else { panic!() };
            let value = ParameterValue { parameter: Parameter::FirstEpoch as u16, value };
            let report = ParameterReport {
                number: command.number,
                outcome: ParameterOutcome::Done,
                values: core::iter::once(value).collect(),
            };
            match cure.reported(&mut errors, &report, Instant(0)) {
                Some(CureStep::Retire(epoch)) => Some(epoch),
                _ => None,
            }
        };
        assert_eq!(retired(5 + EPOCHS_AHEAD as i32), Some(Epoch(4_101)));
        for value in [0, -1, 4_100, LAST_EPOCH as i32] {
            assert_eq!(retired(value), None);
        }
    }

    #[test]
    fn a_robot_that_refuses_parameters_ends_the_cure() {
        let turn = Angle::from_degrees(3.0);
        for mut cure in [Cure::Asking { number: 7, turn }, Cure::Mounting { number: 7, turn }] {
            let mut errors = ConstantErrors::default();
            let report = ParameterReport {
                number: 7,
                outcome: ParameterOutcome::Unknown,
                values: heapless::Vec::new(),
            };
            let step = cure.reported(&mut errors, &report, Instant(0));
            assert!(matches!(step, Some(CureStep::GiveUp)));
            assert!(matches!(cure, Cure::None));
            assert_eq!(errors.cured().added, 0.0);
        }
    }
}
