//! The `ubimap` command line.

use std::{
    fmt,
    io::{self, Write},
    path::Path,
    process::ExitCode,
};

use clap::{Parser, Subcommand, error::ErrorKind};
use serde::Serialize;
use ubimap_sim_host::{
    report::json_pretty,
    run::{
        Outcome, RunError, compare, open_output,
        options::{CompareOptions, ReplayOptions, ServeOptions, SimulateOptions, WatchOptions},
        place::{self, options::PlaceOptions},
        replay, serve, simulate, watch,
    },
};

/// Exit code of a failed run, including one whose maps have not converged.
const FAILED: u8 = 1;
/// Exit code for wrong usage or invalid input.
const BAD_INPUT: u8 = 2;

/// One live indoor map shared by ceiling cameras and cheap robots.
#[derive(Parser)]
#[command(name = "ubimap", version)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Run robots on recorded logs
    Replay(ReplayOptions),
    /// Run robots in a simulated room
    Simulate(SimulateOptions),
    /// Run the camera server on recorded frames of fixed RGB-D cameras
    Watch(WatchOptions),
    /// Find out where to hang a room's cameras
    Place(PlaceOptions),
    /// Serve real robots on serial ports
    Serve(ServeOptions),
    /// Score one ROS map against another
    Compare(CompareOptions),
}

fn main() -> ExitCode {
    start_logging();
    let command_line = match CommandLine::try_parse() {
        Ok(command_line) => command_line,
        Err(error) => return refuse_use(&error),
    };
    let finished = match command_line.command {
        Command::Replay(options) => {
            finish(options.run.results(), || replay::run(&options), |it| it.map.converged)
        }
        Command::Simulate(options) => {
            finish(options.run.results(), || simulate::run(&options), |it| it.map.converged)
        }
        Command::Watch(options) => {
            finish((options.out.as_deref(), options.json), || watch::run(&options), |_| true)
        }
        Command::Place(options) => place(&options),
        Command::Serve(options) => serve(&options),
        Command::Compare(options) => compare(&options),
    };
    finished.unwrap_or_else(|error| {
        complain(&error.to_string());
        ExitCode::from(if error.is_bad_input() { BAD_INPUT } else { FAILED })
    })
}

/// Runs a command and writes its results; `is_success` decides the exit code from the report.
fn finish<R: fmt::Display + Serialize>(
    (out, json): (Option<&Path>, bool),
    run: impl FnOnce() -> Result<Outcome<R>, RunError>,
    is_success: impl FnOnce(&R) -> bool,
) -> Result<ExitCode, RunError> {
    let folder = open_output(out)?;
    let outcome = run()?;
    if let Some(folder) = folder {
        outcome.write(folder)?;
    }
    Ok(tell(&outcome.report, json, is_success(&outcome.report)))
}

/// Success is a placement that keeps what was asked for; also of its connection.
fn place(options: &PlaceOptions) -> Result<ExitCode, RunError> {
    let folder = open_output(options.out.as_deref())?;
    let outcome = place::run(options)?;
    if let Some(folder) = folder {
        outcome.write(folder)?;
    }
    let is_success = !options.connect || outcome.report.is_connected();
    Ok(tell(&outcome.report, options.json, is_success))
}

fn serve(options: &ServeOptions) -> Result<ExitCode, RunError> {
    let report = serve::run(options)?;
    Ok(tell(&report, options.json, report.has_robot()))
}

/// Prints a report and returns the exit code.
fn tell(report: &(impl fmt::Display + Serialize), json: bool, is_success: bool) -> ExitCode {
    print(&if json { json_pretty(report) } else { report.to_string() });
    if is_success { ExitCode::SUCCESS } else { ExitCode::from(FAILED) }
}

fn compare(options: &CompareOptions) -> Result<ExitCode, RunError> {
    let scores = compare::run(options)?;
    print(&if options.json { scores.to_json_pretty() } else { compare::describe(&scores) });
    Ok(ExitCode::SUCCESS)
}

/// Logs to standard error, at `info` and above unless `RUST_LOG` is set.
fn start_logging() {
    let environment = env_logger::Env::default().default_filter_or("info");
    env_logger::Builder::from_env(environment)
        .format(|out, record| {
            let level = record.level().as_str().to_ascii_lowercase();
            writeln!(out, "ubimap: {level}: {}", record.args())
        })
        .init();
}

/// Prints help and the version to standard output, and usage errors to standard error in one line.
fn refuse_use(error: &clap::Error) -> ExitCode {
    if matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion) {
        print(&error.to_string());
        return ExitCode::SUCCESS;
    }
    let text = error.to_string();
    let of_interest: Vec<&str> = text
        .lines()
        .map(str::trim)
        .take_while(|line| !line.starts_with("Usage:"))
        .filter(|line| {
            !["For more information", "tip:"].iter().any(|start| line.starts_with(start))
        })
        .filter(|line| !line.is_empty())
        .collect();
    let message = of_interest.join(" ");
    let message = if error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand {
        "no command given"
    } else {
        message.strip_prefix("error: ").unwrap_or(&message)
    };
    complain(&format!("{message} (see ubimap --help)"));
    ExitCode::from(BAD_INPUT)
}

fn complain(message: &str) {
    let one_line = message.lines().collect::<Vec<_>>().join(" ");
    // If standard error is closed, there is nowhere to report it.
    let _ = writeln!(io::stderr(), "ubimap: {one_line}");
}

/// Prints to standard output, ignoring a closed pipe.
fn print(text: &str) {
    let mut out = io::stdout().lock();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}
