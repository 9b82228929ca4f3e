//! The `ubimap` command line.

use std::{
    fmt,
    io::{self, Write},
    process::ExitCode,
};

use clap::{
    CommandFactory, Parser, Subcommand,
    error::{ContextKind, ContextValue, ErrorKind},
};
use log::LevelFilter;
use serde::Serialize;
use ubimap_sim_host::{
    report::{Brief, OutputFile, OutputFolder, brief, json_pretty},
    run::{
        Outcome, RunError, backup,
        bench::{
            monitor::{self, MonitorOptions},
            param::{self, ParamOptions},
            ports::{self, PortsOptions},
            sensor::{self, SensorOptions},
            wheels::{self, WheelsOptions},
        },
        calibrate::{self, options::CalibrateOptions},
        compare,
        conformance::{self, options::ConformanceOptions},
        control::{GoOptions, RobotsOptions, StatusOptions},
        decode::{self, DecodeOptions},
        init::{self, InitOptions},
        interruption, keys,
        marker_sheet::{self, MarkersOptions},
        options::{
            BackupOptions, CompareOptions, KeysOptions, ReplayOptions, ResultOptions, ServeOptions,
            SimulateOptions, Verbosity, WatchOptions,
        },
        place::{self, options::PlaceOptions},
        provision::{self, ProvisionOptions},
        replay,
        reproduce::{self, ReproduceOptions},
        robot::{self, RobotOptions},
        scale::{self, ScaleOptions},
        serve::{
            self,
            recording::{self, RecordOptions},
        },
        simulate, terminal, watch,
    },
};

#[cfg(target_os = "linux")]
use ubimap_sim_host::run::rig::{self, RigOptions};

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
    #[command(flatten)]
    verbosity: Verbosity,
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
    /// Find out where cameras hang, from landmarks that they see in common
    Calibrate(CalibrateOptions),
    /// Serve cameras and robots, live
    Serve(ServeOptions),
    /// Record the frames of a deployment's cameras, for calibrate and watch
    Record(RecordOptions),
    /// Run a robot's program on a computer with serial ports
    Robot(RobotOptions),
    /// Play the outside world: a simulated room with cameras and robots' devices, for serve and robot
    #[cfg(target_os = "linux")]
    Rig(RigOptions),
    /// Write a commented deployment for serve
    Init(InitOptions),
    /// Show the serial ports of this computer, and which robots say hello there
    Ports(PortsOptions),
    /// Show what the robot at a port reports: state, events, counters
    Monitor(MonitorOptions),
    /// Read and change the parameters of the robot at a port
    Param(ParamOptions),
    /// Draw what the robot at a port sees
    ///
    /// The robot sends up to one view per second: the free distance in each of up to 64 columns, from the middle
    /// between its wheels. The rows of a depth image do not travel, and no robot measures its sensor's tilt; so a
    /// tilted sensor shows by its consequence. One that looks down sees the floor, as a straight line across that
    /// stays when the robot turns. One that looks up sees over low things, which nothing here tells.
    Sensor(SensorOptions),
    /// Turn the wheels of the robot at a port a little, and tell what is wrong with them
    ///
    /// Put the robot on the floor with half a metre free around it and more ahead, best with a wall or furniture in
    /// its view. It drives ahead by --way, and then turns to the left; it keeps its own rules, so it stops for
    /// obstacles, bumpers and Ctrl-C. Its own sensor tells, if it sees enough, how it has really moved; so does a
    /// person (--saw-ahead, --saw-turn, --ask).
    Wheels(WheelsOptions),
    /// Draw sheets of the robots' markers to print, with the lines of the deployment that go with them
    Markers(MarkersOptions),
    /// Send a robot of the running server to a place
    ///
    /// It drives there by a way that the server finds through known free ground, also if it was stopped. When it
    /// has arrived, a robot that explores (serve --explore, or the command explore) goes on exploring; another one
    /// stays. To make it stay: ubimap stop ROBOT when it is there.
    Go(GoOptions),
    /// Stop a robot of the running server, or all
    Stop(RobotsOptions),
    /// Let a robot of the running server, or all, explore
    Explore(RobotsOptions),
    /// Show robots, cameras and map of the running server
    ///
    /// First comes each robot with its newest pose, from cameras or its own reports, whichever is newer, and what
    /// it is doing. Below, each port has what the robot itself last reported, which is up to 2 s older, the
    /// counters of its link, and its newest events: one that came several times is listed once, at its last time.
    Status(StatusOptions),
    /// Make, list and retire the keys of robots
    Keys(KeysOptions),
    /// Write a robot's number, key and parameters into a firmware image
    Provision(ProvisionOptions),
    /// Copy the file of --store, even while the server is running
    Backup(BackupOptions),
    /// Score one ROS map against another
    Compare(CompareOptions),
    /// Run the experiments of the three papers that ubimap follows, and write a page that compares
    Reproduce(ReproduceOptions),
    /// Fit the scale curve of a robot's grey camera (Ahmed, table 1 and equation 1)
    Scale(ScaleOptions),
    /// Check another implementation of the protocol, robot or server, against SPEC.md
    ///
    /// Takes some seven minutes. To a robot the runner is a server with cells of 50 mm, which sends fixes near x = -1 m, y = 1 m:
    /// there the robot should draw within seconds, and its map should change every few seconds; otherwise checks of
    /// tiles are skipped.
    Conformance(ConformanceOptions),
    /// Put captured bytes of a link into words, frame by frame
    Decode(DecodeOptions),
}

fn main() -> ExitCode {
    let CommandLine { command, verbosity } = match CommandLine::try_parse() {
        Ok(command_line) => command_line,
        Err(error) => return refuse_use(&error),
    };
    if !matches!(
        command,
        Command::Calibrate(_)
            | Command::Compare(_)
            | Command::Backup(_)
            | Command::Conformance(_)
            | Command::Decode(_)
            | Command::Keys(_)
            | Command::Provision(_)
            | Command::Scale(_)
    ) {
        interruption::listen();
    }
    let level = match runs_until_stopped(&command) && !verbosity.quiet {
        // Its messages are its only output.
        true if verbosity.verbose == 0 => LevelFilter::Info,
        true => verbosity.level().max(LevelFilter::Debug),
        false => verbosity.level(),
    };
    terminal::start_logging(level);
    let is_verbose = verbosity.verbose > 0;
    let finished = match command {
        Command::Replay(options) => {
            let results = (&options.run.results, is_verbose);
            finish(results, || replay::run(&options), |it| it.map.converged && it.has_mapped())
        }
        Command::Simulate(options) => {
            let results = (&options.run.results, is_verbose);
            finish(results, || simulate::run(&options), |it| it.map.converged)
        }
        Command::Watch(options) => {
            finish((&options.results, is_verbose), || watch::run(&options), |_| true)
        }
        Command::Place(options) => place(&options),
        Command::Calibrate(options) => calibrate(&options),
        Command::Serve(options) => serve(&options),
        Command::Robot(options) => robot::run(&options).map(|()| ExitCode::SUCCESS),
        #[cfg(target_os = "linux")]
        Command::Rig(options) => rig(&options),
        Command::Record(options) => recording::run(&options).and_then(|it| answered(&it)),
        Command::Init(options) => init(&options),
        Command::Ports(options) => ports(&options),
        Command::Monitor(options) => monitor::run(&options).map(|()| ExitCode::SUCCESS),
        Command::Param(options) => param::run(&options).and_then(|it| answered(&it)),
        Command::Sensor(options) => sensor::run(&options).map(|()| ExitCode::SUCCESS),
        Command::Wheels(options) => wheels(&options),
        Command::Markers(options) => marker_sheet::run(&options).and_then(|it| answered(&it)),
        Command::Go(options) => options.run().and_then(|answer| answered(&answer)),
        Command::Stop(options) => options.run("stop").and_then(|answer| answered(&answer)),
        Command::Explore(options) => options.run("explore").and_then(|answer| answered(&answer)),
        Command::Status(options) => options.run().and_then(|answer| answered(&answer)),
        Command::Keys(options) => keys(&options),
        Command::Provision(options) => {
            provision::run(&options).map_err(RunError::from).and_then(|it| answered(&it))
        }
        Command::Backup(options) => backup(&options),
        Command::Compare(options) => compare(&options),
        Command::Reproduce(options) => reproduce::run(&options)
            .and_then(|page| answered(&format!("page: {}\n", page.display()))),
        Command::Scale(options) => scale(&options),
        Command::Conformance(options) => conformance(&options),
        Command::Decode(options) => decode(&options),
    };
    finished.unwrap_or_else(|error| fail(&error))
}

fn runs_until_stopped(command: &Command) -> bool {
    match command {
        Command::Serve(_) | Command::Robot(_) => true,
        #[cfg(target_os = "linux")]
        Command::Rig(_) => true,
        _ => false,
    }
}

/// Prints why a run failed. Returns the exit code.
fn fail(error: &RunError) -> ExitCode {
    complain(&error.to_string());
    ExitCode::from(if error.is_bad_input() { BAD_INPUT } else { FAILED })
}

/// Runs a command, writes its results and prints where they are, and all figures if `is_verbose`.
/// `is_success` decides the exit code from the report.
fn finish<R: Brief + fmt::Display + Serialize>(
    (options, is_verbose): (&ResultOptions, bool),
    run: impl FnOnce() -> Result<Outcome<R>, RunError>,
    is_success: impl FnOnce(&R) -> bool,
) -> Result<ExitCode, RunError> {
    // Before the run, so that a folder that can't be written fails at once.
    let folder = OutputFolder::create(&options.out)?;
    let outcome = run()?;
    if interruption::is_requested() {
        log::warn!("interrupted: the results are those of the run until then");
    }
    outcome.write(folder)?;
    let report = &outcome.report;
    if options.json {
        print(&json_pretty(report))?;
    } else {
        let figures = if is_verbose { report.to_string() } else { String::new() };
        print(&(figures + &brief(report, &options.out)))?;
    }
    Ok(status(is_success(report) || interruption::is_requested()))
}

fn status(is_success: bool) -> ExitCode {
    if is_success { ExitCode::SUCCESS } else { ExitCode::from(FAILED) }
}

/// Succeeds if the placement meets the request, including `--connect`.
fn place(options: &PlaceOptions) -> Result<ExitCode, RunError> {
    let folder = OutputFolder::create(&options.out)?;
    let outcome = place::run(options)?;
    outcome.write(folder)?;
    let report = &outcome.report;
    if options.json {
        print(&json_pretty(report))?;
    } else {
        print(&format!(
            "{report}results: in {}; open coverage.png first\n",
            options.out.display()
        ))?;
    }
    Ok(status(!options.connect || report.is_connected()))
}

/// Succeeds if every camera has a pose.
fn calibrate(options: &CalibrateOptions) -> Result<ExitCode, RunError> {
    let file = OutputFile::create(&options.out)?;
    let outcome = calibrate::run(options)?;
    file.finish(outcome.cameras.as_bytes())?;
    let report = &outcome.report;
    if options.json {
        print(&json_pretty(report))?;
    } else {
        print(&format!("{report}cameras: in {}\n", options.out.display()))?;
    }
    Ok(status(report.is_complete()))
}

fn serve(options: &ServeOptions) -> Result<ExitCode, RunError> {
    let report = serve::run(options)?;
    print(&if options.json { json_pretty(&report) } else { report.to_string() })?;
    Ok(status(report.has_robot() || interruption::is_requested()))
}

#[cfg(target_os = "linux")]
fn rig(options: &RigOptions) -> Result<ExitCode, RunError> {
    let report = rig::run(options)?;
    answered(&if options.json { json_pretty(&report) } else { report.to_string() })
}

fn init(options: &InitOptions) -> Result<ExitCode, RunError> {
    let file = init::run(options)?;
    let file = file.display();
    answered(&format!("{file}: edit it, then run: ubimap serve {file} --open\n"))
}

fn ports(options: &PortsOptions) -> Result<ExitCode, RunError> {
    let report = ports::run(options)?;
    answered(&if options.json { json_pretty(&report) } else { report.to_string() })
}

/// Succeeds if nothing is wrong.
fn wheels(options: &WheelsOptions) -> Result<ExitCode, RunError> {
    let report = wheels::run(options)?;
    print(&if options.json { json_pretty(&report) } else { report.to_string() })?;
    Ok(status(report.is_good()))
}

fn answered(answer: &str) -> Result<ExitCode, RunError> {
    print(answer)?;
    Ok(ExitCode::SUCCESS)
}

fn backup(options: &BackupOptions) -> Result<ExitCode, RunError> {
    let tiles = backup::run(options)?;
    let to = options.to.display();
    print(&format!("{to}: a backup of {tiles} robot tiles; use it with --store {to}\n"))?;
    Ok(ExitCode::SUCCESS)
}

fn keys(options: &KeysOptions) -> Result<ExitCode, RunError> {
    print(&keys::run(options)?)?;
    Ok(ExitCode::SUCCESS)
}

fn compare(options: &CompareOptions) -> Result<ExitCode, RunError> {
    let scores = compare::run(options)?;
    print(&if options.json { scores.to_json_pretty() } else { compare::describe(&scores) })?;
    Ok(ExitCode::SUCCESS)
}

fn scale(options: &ScaleOptions) -> Result<ExitCode, RunError> {
    let fit = scale::run(options)?;
    if options.json {
        print(&json_pretty(&fit))?;
    } else {
        let first =
            if options.table.is_some() { scale::table_1()?.to_string() } else { String::new() };
        print(&(first + &fit.to_string()))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Succeeds if no check has failed.
fn conformance(options: &ConformanceOptions) -> Result<ExitCode, RunError> {
    if options.list {
        print(&conformance::list(options.role.into()))?;
        return Ok(ExitCode::SUCCESS);
    }
    let file = options.junit.as_deref().map(OutputFile::create).transpose()?;
    let mut printed = Ok(());
    let report = conformance::run(options, |result| {
        if !options.json && printed.is_ok() {
            printed = print(&result.to_string());
        }
    })?;
    printed?;
    if let Some(file) = file {
        file.finish(report.junit().as_bytes())?;
    }
    print(&if options.json { json_pretty(&report) } else { report.to_string() })?;
    Ok(status(report.conforms()))
}

fn decode(options: &DecodeOptions) -> Result<ExitCode, RunError> {
    print(&decode::run(options)?)?;
    Ok(ExitCode::SUCCESS)
}

/// Prints help and the version to standard output, and usage errors to standard error in one line.
fn refuse_use(error: &clap::Error) -> ExitCode {
    if matches!(error.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion) {
        return match print(&error.to_string()) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => fail(&error),
        };
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
    let meant = meant(error).map_or(String::new(), |it| format!("; did you mean {it}?"));
    let command = std::env::args().skip(1).find(|word| !word.starts_with('-'));
    let known = command.filter(|it| CommandLine::command().find_subcommand(it).is_some());
    let of = known.map_or(String::new(), |command| format!("{command} "));
    complain(&format!("{message}{meant} (see ubimap {of}--help)"));
    ExitCode::from(BAD_INPUT)
}

/// The suggestion for a mistyped name.
fn meant(error: &clap::Error) -> Option<&str> {
    let kinds =
        [ContextKind::SuggestedArg, ContextKind::SuggestedSubcommand, ContextKind::SuggestedValue];
    kinds.into_iter().find_map(|kind| match error.get(kind)? {
        ContextValue::String(one) => Some(one.as_str()),
        ContextValue::Strings(several) => several.first().map(String::as_str),
        _ => None,
    })
}

fn complain(message: &str) {
    let one_line = message.lines().collect::<Vec<_>>().join(" ");
    // If standard error is closed, there is nowhere to report it.
    let _ = writeln!(io::stderr(), "ubimap: {one_line}");
}

/// Prints to standard output. A closed pipe is not an error: the reader wants no more.
fn print(text: &str) -> Result<(), RunError> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(RunError::Print(error)),
        _ => Ok(()),
    }
}
