//! The cure of a robot's constant errors, step by step: the fixes are corrected, or the sensor's
//! mounting on the robot; then what was drawn before is retired.

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

/// How long a robot's filter takes to follow a correction of its fixes.
const SETTLING: Duration = Duration::from_secs(3);
/// How far a robot's epochs may be ahead of those that the server has heard of: it begins one with
/// each tile that leaves its pool.
const EPOCHS_AHEAD: u32 = 4_096;
/// The highest epoch that a robot is told to begin with.
const LAST_EPOCH: u32 = 1 << 30;

/// How far a cure has come.
#[derive(Debug, Default)]
pub(super) enum Cure {
    #[default]
    None,
    /// An earlier life of the server left it where the robot's older epochs are to be retired.
    LeftOff,
    /// The fixes are corrected; the robot's older epochs are retired when its filter has followed.
    Settling(Instant),
    /// The sensor's error is found. The angle is to be added.
    Found { turn: Angle },
    /// The robot is asked how it believes its sensor to be mounted.
    Asking { number: u16, turn: Angle },
    /// It is told how.
    Mounting { number: u16, turn: Angle },
    /// It is told to begin its tiles anew.
    Retiring { number: u16 },
}

/// A step of a cure.
pub(super) enum CureStep {
    /// The robot is to be told this.
    Tell(ParameterCommand),
    /// Fixes are corrected from now on; the progress is to be kept.
    IdentifierCorrected,
    /// The sensor's error was found, or the sensor is corrected; the progress is to be kept.
    SensorCorrected,
    /// The cure is over without effect.
    GiveUp,
    /// The cure is over: the tiles of epochs below this one are void.
    Retire(Epoch),
}

impl Cure {
    /// The next step, if one is due. `next` is the first epoch that the robot is not known to have
    /// used.
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
                *self = Self::Retiring { number };
                let epoch = next.0.saturating_add(EPOCHS_AHEAD).min(LAST_EPOCH);
                (number, set(Parameter::FirstEpoch, epoch as i32))
            }
            _ => return None,
        };
        Some(CureStep::Tell(ParameterCommand { number, action }))
    }

    /// Takes the robot's answer to one of the cure's commands.
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
            Self::Retiring { number } if number == report.number => {
                *self = Self::None;
                Some(CureStep::Retire(Epoch(u32::try_from(value?).ok()?)))
            }
            _ => None,
        }
    }

    /// The robot does not take the parameter: everything begins again.
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
    fn with_a_robot_that_refuses_nothing_is_cured_and_the_cure_is_over() {
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
