//! `ubimap param`: a robot's parameters, by name.

use std::fmt::Write as _;

use clap::{Args, Subcommand};
use serde::Serialize;
use ubimap_agent::Parameter;
use ubimap_protocol::message::{
    ParameterAction, ParameterOutcome, ParameterReport, ParameterValue,
};

use super::{
    options::PortOptions,
    quantity::{meaning, named, parsed, range, shown, unit},
    session::Bench,
};
use crate::{report::json_pretty, run::RunError};

/// Options of `ubimap param`.
#[derive(Args, Clone, Debug)]
pub struct ParamOptions {
    /// The robot's port.
    #[command(flatten)]
    pub port: PortOptions,

    /// What to do.
    #[command(subcommand)]
    pub action: ParamAction,
}

/// What to do with parameters.
#[derive(Clone, Debug, Subcommand)]
pub enum ParamAction {
    /// Show all parameters of the robot, with unit, range and meaning
    List {
        /// Print them as JSON
        #[arg(long)]
        json: bool,
    },
    /// Show one
    Get {
        /// Its name
        name: String,
    },
    /// Change one, until the robot's next boot
    Set {
        /// Its name
        name: String,
        /// The value in the unit that list shows, such as 12, -3.5, 7..9 or none
        #[arg(allow_hyphen_values = true)]
        value: String,
    },
    /// Let the robot store its parameters for its later boots; its wheels must stand
    Store,
}

/// A parameter for people and programs.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Shown {
    name: String,
    value: String,
    unit: &'static str,
    range: String,
    meaning: &'static str,
    /// The number and the value on the wire.
    number: u16,
    raw: i32,
}

impl Shown {
    fn new(ParameterValue { parameter: number, value }: &ParameterValue) -> Self {
        let known = Parameter::ALL.iter().copied().find(|it| *it as u16 == *number);
        Self {
            name: known.map_or_else(|| number.to_string(), |it| it.name().to_owned()),
            value: known.map_or_else(|| value.to_string(), |it| shown(it, *value)),
            unit: known.map_or("", unit),
            range: known.map_or_else(String::new, range),
            meaning: known.map_or("unknown to this version", meaning),
            number: *number,
            raw: *value,
        }
    }

    fn line(&self) -> String {
        let Self { name, value, unit, .. } = self;
        format!("{name} = {value} {unit}").trim_end().to_owned()
    }
}

/// Does it. Returns what to print.
///
/// # Errors
/// [`RunError::Bench`] if the robot does not answer, or refuses.
pub fn run(options: &ParamOptions) -> Result<String, RunError> {
    let usage = |reason| RunError::Parameter { reason };
    // Before the port is opened, so that a typing error costs no time.
    let command = match &options.action {
        ParamAction::List { .. } => ParameterAction::List,
        ParamAction::Store => ParameterAction::Get(Parameter::Stored as u16),
        ParamAction::Get { name } => ParameterAction::Get(named(name).map_err(usage)? as u16),
        ParamAction::Set { name, value } => {
            let parameter = named(name).map_err(usage)?;
            let value = parsed(parameter, value).map_err(usage)?;
            ParameterAction::Set(ParameterValue { parameter: parameter as u16, value })
        }
    };
    let mut bench = Bench::open(&options.port)?;
    let robot = bench.wait_for_robot()?.0;
    if matches!(options.action, ParamAction::Store) {
        return store(&mut bench, robot);
    }
    let report = bench.parameter(command)?;
    match report.outcome {
        ParameterOutcome::Done => Ok(answer(&options.action, robot, &report)),
        ParameterOutcome::Unknown => Err(bench.fault("the robot has no such parameter")),
        ParameterOutcome::OutOfRange => {
            Err(bench.fault("the robot refuses the value: it is out of its range"))
        }
    }
}

fn answer(action: &ParamAction, robot: u16, report: &ParameterReport) -> String {
    let all: Vec<Shown> = report.values.iter().map(Shown::new).collect();
    let line = |it: &Shown| match action {
        ParamAction::Set { .. } => {
            format!(
                "{}   # of robot {robot}, until its next boot: see ubimap param store\n",
                it.line()
            )
        }
        _ => format!("{}   # {}; {}\n", it.line(), it.range, it.meaning),
    };
    match action {
        ParamAction::List { json: true } => json_pretty(&all),
        ParamAction::List { json: false } => table(&all),
        _ => all.iter().map(line).collect(),
    }
}

/// Lets the robot store its parameters. Returns what to print.
fn store(bench: &mut Bench, robot: u16) -> Result<String, RunError> {
    let list = bench.parameter(ParameterAction::List)?;
    let value =
        |of: Parameter| list.values.iter().find(|it| it.parameter == of as u16).map(|it| it.value);
    match value(Parameter::Stored) {
        None => return Err(bench.fault(in_image(robot, &list.values))),
        Some(0) => {}
        Some(_) => return Ok(format!("robot {robot} has stored them: nothing differs\n")),
    }
    if value(Parameter::GateDistance) == Some(0) {
        return Err(bench.fault(
            "gate-distance is 0 mm, as a killed ubimap sensor or wheels leaves it: set it (35 is usual), then store",
        ));
    }
    let stored = ParameterValue { parameter: Parameter::Stored as u16, value: 1 };
    match bench.parameter(ParameterAction::Set(stored))?.outcome {
        ParameterOutcome::Done => {
            Ok(format!("stored: the next boots of robot {robot} begin with these parameters\n"))
        }
        _ => Err(bench.fault(format!(
            "robot {robot} has not stored its parameters: its wheels turn, or did a second ago; or its flash, or its \
             computer's folder, can't be written"
        ))),
    }
}

fn table(all: &[Shown]) -> String {
    let wide = |text: fn(&Shown) -> usize| all.iter().map(text).max().unwrap_or(0);
    let (names, values) = (wide(|it| it.name.len()), wide(|it| it.value.len() + 1 + it.unit.len()));
    let mut text = String::new();
    for it in all {
        let (name, value) = (&it.name, format!("{} {}", it.value, it.unit));
        // Writing to a string can't fail.
        let _ = writeln!(text, "{name:<names$}  {value:<values$}  {} ({})", it.meaning, it.range);
    }
    text
}

/// How to keep the values of a robot that can't store them, in one line. Its first epoch is the server's business.
fn in_image(robot: u16, values: &[ParameterValue]) -> String {
    let mut text = format!(
        "robot {robot} can't store parameters: put them into an image that is built with the feature flash, by ubimap \
         provision IMAGE --id {robot}"
    );
    for ParameterValue { parameter, value } in values {
        let known = Parameter::ALL.iter().find(|it| **it as u16 == *parameter);
        if let Some(known) = known.filter(|it| **it != Parameter::FirstEpoch) {
            // Writing to a string can't fail.
            let _ = write!(text, " --set {}={value}", known.name());
        }
    }
    text
}
