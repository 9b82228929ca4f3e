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

/// The command to store all parameters.
const STORE: ParameterAction =
    ParameterAction::Set(ParameterValue { parameter: Parameter::Stored as u16, value: 1 });

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
        ParamAction::Store => STORE,
        ParamAction::Get { name } => ParameterAction::Get(named(name).map_err(usage)? as u16),
        ParamAction::Set { name, value } => {
            let parameter = named(name).map_err(usage)?;
            let value = parsed(parameter, value).map_err(usage)?;
            ParameterAction::Set(ParameterValue { parameter: parameter as u16, value })
        }
    };
    let mut bench = Bench::open(&options.port)?;
    bench.wait_for_robot()?;
    let report = bench.parameter(command)?;
    match report.outcome {
        ParameterOutcome::Done => {}
        ParameterOutcome::Unknown if command == STORE => {
            return Ok(in_image(&bench.parameter(ParameterAction::List)?.values));
        }
        ParameterOutcome::OutOfRange if command == STORE => {
            return Err(bench.fault(
                "the robot has not stored its parameters: its wheels turn (ubimap stop halts them), or its flash \
                 does not keep what is written; they apply until its next boot",
            ));
        }
        ParameterOutcome::Unknown => return Err(bench.fault("the robot has no such parameter")),
        ParameterOutcome::OutOfRange => {
            return Err(bench.fault("the robot refuses the value: it is out of its range"));
        }
    }
    Ok(answer(&options.action, &report))
}

fn answer(action: &ParamAction, report: &ParameterReport) -> String {
    let all: Vec<Shown> = report.values.iter().map(Shown::new).collect();
    match action {
        ParamAction::List { json: true } => json_pretty(&all),
        ParamAction::List { json: false } => table(&all),
        ParamAction::Get { .. } => {
            let one = |it: &Shown| format!("{}   # {}; {}\n", it.line(), it.range, it.meaning);
            all.iter().map(one).collect()
        }
        ParamAction::Set { .. } => {
            let one = |it: &Shown| {
                format!("{}   # until its next boot: see ubimap param store\n", it.line())
            };
            all.iter().map(one).collect()
        }
        ParamAction::Store => "stored: the robot's next boots begin with these parameters\n".into(),
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

/// How to keep the values of a robot that can't store them. Its first epoch is the server's business.
fn in_image(values: &[ParameterValue]) -> String {
    let mut text = String::from(
        "This robot can't store parameters. Put them into its image, built with the feature flash, and flash \
         that:\n\n    ubimap provision IMAGE --id N",
    );
    for ParameterValue { parameter, value } in values {
        let known = Parameter::ALL.iter().find(|it| **it as u16 == *parameter);
        if let Some(known) = known.filter(|it| **it != Parameter::FirstEpoch) {
            // Writing to a string can't fail.
            let _ = write!(text, " \\\n        --set {}={value}", known.name());
        }
    }
    text + "\n\n(values as on the wire, SPEC section 6)\n"
}
