//! Checks of a robot's parameters (SPEC 6).

use ubimap_protocol::message::{
    ParameterAction, ParameterCommand, ParameterOutcome, ParameterReport, ParameterValue, ToRobot,
    ToServer,
};

use super::super::{
    check::Check,
    frames::Note,
    halt::{Halt, fail, skip},
    talk::Talk,
};

/// How long changes are gathered, from 0 to 60,000 ms.
const HOLD: u16 = 6;
/// The parameter that says whether the others are stored.
const STORED: u16 = 13;

pub(super) const CHECKS: &[Check] = &[
    Check {
        name: "parameter-list",
        section: "6",
        rule: "a list command is answered with all parameters, unknown ones are named so",
        run: parameters,
    },
    Check {
        name: "parameter-out-of-range",
        section: "6",
        rule: "a value out of range is refused, and changes nothing",
        run: out_of_range,
    },
    Check {
        name: "parameter-stored",
        section: "6",
        rule: "a robot says whether its next boot begins with its present parameters",
        run: stored,
    },
];

fn command(talk: &mut Talk<'_>, action: ParameterAction) -> Result<ParameterReport, Halt> {
    talk.asked += 1;
    let number = talk.asked;
    talk.reliable(&[Note::new::<ToRobot, _>(&ParameterCommand { number, action })])?;
    let span = talk.patience();
    let until = talk.now() + span;
    while let Some(seen) = talk.next(until)? {
        if let Some(report) =
            seen.bodies::<ToServer, ParameterReport>().find(|report| report.number == number)
        {
            return Ok(report);
        }
    }
    fail(format!("a ParameterReport with number {number}"), "none")
}

fn parameters(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let report = command(talk, ParameterAction::List)?;
    if report.outcome != ParameterOutcome::Done {
        return fail("outcome done for a list", format!("{:?}", report.outcome));
    }
    let unknown = command(talk, ParameterAction::Get(9_999))?;
    if unknown.outcome != ParameterOutcome::Unknown || !unknown.values.is_empty() {
        return fail("outcome unknown without values for parameter 9,999", format!("{unknown:?}"));
    }
    for value in &report.values {
        let got = command(talk, ParameterAction::Get(value.parameter))?;
        if got.outcome != ParameterOutcome::Done || got.values[..] != [*value] {
            return fail(format!("{value:?}, as in the list"), format!("{got:?}"));
        }
    }
    Ok(())
}

fn out_of_range(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let before = command(talk, ParameterAction::List)?;
    let Some(mounting) = before.values.iter().find(|it| it.parameter == 1) else {
        return skip("the robot has no parameter 1");
    };
    let set = command(talk, ParameterAction::Set(ParameterValue { parameter: 1, value: 2_001 }))?;
    if set.outcome != ParameterOutcome::OutOfRange {
        return fail(
            "outcome out of range for parameter 1 = 2,001 mm",
            format!("{:?}", set.outcome),
        );
    }
    let after = command(talk, ParameterAction::Get(1))?;
    if after.values[..] == [*mounting] {
        return Ok(());
    }
    fail(format!("{mounting:?} still"), format!("{after:?}"))
}

/// Nothing is stored, so the tested robot's next boot begins as it would have.
fn stored(talk: &mut Talk<'_>) -> Result<(), Halt> {
    talk.open()?;
    let list = command(talk, ParameterAction::List)?;
    let value = |number| list.values.iter().find(|it| it.parameter == number).map(|it| it.value);
    let (Some(before), Some(hold)) = (value(STORED), value(HOLD)) else {
        return skip("the robot has no parameter 13, or no parameter 6");
    };
    let set = |parameter, value| ParameterAction::Set(ParameterValue { parameter, value });
    let zero = command(talk, set(STORED, 0))?;
    if zero.outcome != ParameterOutcome::OutOfRange {
        return fail("outcome out of range for parameter 13 = 0", format!("{:?}", zero.outcome));
    }
    let other = if hold > 0 { hold - 1 } else { 1 };
    for (hold, stored) in [(other, 0), (hold, before)] {
        command(talk, set(HOLD, hold))?;
        let report = command(talk, ParameterAction::Get(STORED))?;
        let expected = ParameterValue { parameter: STORED, value: stored };
        if before == 1 && report.values[..] != [expected] {
            return fail(format!("{expected:?} after parameter 6 = {hold}"), format!("{report:?}"));
        }
    }
    if before == 0 {
        return Ok(());
    }
    // There is nothing to store.
    let report = command(talk, set(STORED, 1))?;
    if report.outcome == ParameterOutcome::Done {
        return Ok(());
    }
    fail("outcome done for parameter 13 = 1, as nothing differs", format!("{:?}", report.outcome))
}
