//! `ubimap rig`: the simulated room as the outside world, in real time, in a process of its own.
//!
//! It sends the frames of its cameras to the stream sockets of `ubimap serve`, and has the devices of each
//! robot, an A010 or an LD06 and a Create 2, at pseudo-terminals for `ubimap robot`. A robot may be built wrongly
//! (`Fault`). The folder that it fills holds
//! the deployment, a configuration for each robot, and links to the pseudo-terminals. Nothing else passes
//! between it and the server; the truth goes into its own report.

mod clock;
mod devices;
mod faults;
mod files;
mod report;
mod sender;

use std::{path::PathBuf, thread, time};

use clap::Args;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::Millimetres,
};

use super::{
    RunError,
    body::CAMERA,
    interruption,
    options::seconds,
    room_stage::RoomStage,
    scoring::{self, TRACK_INTERVAL},
    simulate::RESOLUTION,
    stage::{Event, Stage},
};
use crate::{
    camera::FrameSource,
    grid,
    report::OutputFile,
    world::{Scenario, World},
};

use clock::{Step, WallClock};
use devices::{Devices, Sensor};
use faults::Fault;
pub use report::RigReport;
use sender::Sender;

/// Interval between two looks at the devices.
const TURN: time::Duration = time::Duration::from_millis(1);

/// Options of `ubimap rig`.
#[derive(Args, Clone, Debug)]
pub struct RigOptions {
    /// A scenario, as of simulate
    pub scenario: PathBuf,

    /// The folder for the deployment, the robots' configurations and the ports; files that are there
    /// already are kept
    #[arg(long, value_name = "DIR", default_value = "rig")]
    pub folder: PathBuf,

    /// Number of robots, instead of the scenario's
    #[arg(long, value_name = "N")]
    pub robots: Option<u16>,

    /// UDP port of the server in the deployment
    #[arg(long, value_name = "PORT", default_value_t = 4_000)]
    pub port: u16,

    /// Seed of all random numbers of the room
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,

    /// Build a robot wrongly: 1:left-motor (its wires are swapped), right-motor, left-encoder, right-encoder,
    /// swapped-motors, swapped-encoders, ticks=1.03 (3 % more counts per metre), tilt=4 (the sensor looks
    /// down by 4 degrees); can be repeated
    #[arg(long, value_name = "ROBOT:FAULT")]
    pub fault: Vec<Fault>,

    /// Give these robots an LD06 lidar instead of an A010
    #[arg(long, value_name = "N,M", value_delimiter = ',')]
    pub lidar: Vec<u16>,

    /// Duration in seconds; without it, until stopped
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: Option<Duration>,

    /// Score this map of the server at the end, against the truth
    #[arg(long, value_name = "YAML")]
    pub map: Option<PathBuf>,

    /// Write the robots' true poses to this file at the end, twenty rows a second
    #[arg(long, value_name = "CSV")]
    pub track: Option<PathBuf>,

    /// Set the cameras' clock while the rig runs: at 60 s, forward by an hour
    #[arg(long, value_name = "60:3600")]
    pub set_clock: Option<Step>,

    /// Print the report as JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the room until the time is up or a signal interrupts.
///
/// # Errors
/// [`RunError`] if the scenario is invalid, or the folder or a port can't be made.
pub fn run(options: &RigOptions) -> Result<RigReport, RunError> {
    let mut scenario = Scenario::read_with(&options.scenario, None)?;
    if let Some(robots) = options.robots {
        let (asked, there) = (usize::from(robots), scenario.robots.len());
        if asked > there {
            return Err(RunError::TooManyRobots { asked, there });
        }
        scenario.robots.truncate(asked);
    }
    let named = options.lidar.iter().copied().chain(options.fault.iter().map(|it| it.robot()));
    if let Some(robot) = faults::missing(&scenario, named) {
        let reason = format!("has no robot {robot}, which --fault or --lidar names");
        return Err(RunError::Deployment { path: options.scenario.clone(), reason });
    }
    for robot in &mut scenario.robots {
        faults::tilt(&options.fault, robot);
        *robot = robot.on_create2(CAMERA.binning.side());
        if options.lidar.contains(&robot.id) {
            *robot = robot.clone().with_ld06();
        }
    }
    let world = World::new(&scenario, None, RESOLUTION, options.seed)?;
    let devices = world.robots().iter().map(|robot| {
        let number = robot.id().0;
        let prefix = options.folder.join(format!("robot-{number}"));
        let sensor = Sensor::new(options.lidar.contains(&number));
        Devices::open(&prefix, sensor, faults::wiring(&options.fault, number))
    });
    std::fs::create_dir_all(&options.folder)
        .map_err(|error| files::refused(&options.folder, &error))?;
    let mut devices = devices.collect::<Result<Vec<_>, _>>()?;
    files::write(&options.folder, &scenario, &world, (options.port, &options.lidar))?;
    let clock = WallClock::start(options.set_clock);
    let senders = FrameSource::cameras(&world).iter().enumerate();
    let senders =
        senders.map(|(index, _)| Sender::start(options.folder.join(files::socket(index)), clock));
    let senders = senders.collect::<Result<Vec<_>, _>>()?;

    announce(options, world.robots().len(), senders.len());
    let mut stage = RoomStage::filmed(world, Instant(u64::MAX));
    stage.hand_over();
    let elapsed = || Instant(clock.elapsed());
    let mut late = Duration(0);
    let is_over = |now: Instant| options.duration.is_some_and(|end| now >= Instant(0) + end);
    while !interruption::is_requested() && !is_over(elapsed()) {
        let now = elapsed();
        late = late.max(now.since(stage.world().now()));
        // Each event at its own time: the room may be behind the clock, and a camera's latency hides that.
        loop {
            let bases = devices.iter().enumerate();
            let base = bases.filter_map(|(robot, it)| Some((it.next_measure()?, robot))).min();
            let event = stage.next_event().filter(|&next| next <= now);
            match (base.filter(|&(next, _)| next <= now), event) {
                (Some((next, robot)), event) if event.is_none_or(|event| next <= event) => {
                    devices[robot].measure(robot, &mut stage, next);
                }
                (_, Some(next)) => match stage.poll(next) {
                    Some(Event::Scan { robot, readings }) => devices[robot].scan(&readings, next),
                    Some(Event::Frame(frame)) => senders[frame.camera].send(frame, &clock),
                    Some(Event::Odometry { .. } | Event::Observation(_) | Event::Look { .. })
                    | None => {}
                },
                _ => break,
            }
        }
        for (index, devices) in devices.iter_mut().enumerate() {
            devices.exchange(index, &mut stage, now);
        }
        thread::sleep(TURN);
    }
    let truth = match &options.map {
        Some(path) => Some(scoring::score(&grid::read_map(path)?, stage.world())?),
        None => None,
    };
    if let Some(path) = &options.track {
        OutputFile::create(path)?.finish(track(&stage, clock.began_at()).as_bytes())?;
    }
    let world = stage.world();
    let robots = world.robots().iter().map(|robot| {
        let pose = robot.truth();
        let place = [pose.x, pose.y].map(Millimetres::metres);
        (robot.id().0, [place[0], place[1], pose.heading.degrees()])
    });
    Ok(RigReport {
        schema: "ubimap-rig",
        version: 1,
        robots: robots.collect(),
        collisions: world.contacts().collisions,
        touches: world.contacts().touches,
        frames: senders.iter().map(Sender::counts).collect(),
        late_ms: late.micros() / 1_000,
        truth,
        elapsed_s: clock.elapsed() as f64 / 1e6,
    })
}

/// Says what there is, and what to do next.
fn announce(options: &RigOptions, robots: usize, cameras: usize) {
    let folder = options.folder.display();
    log::info!(
        "the room is there, with {cameras} cameras and {robots} robots: {folder}/deployment.toml"
    );
    log::info!("cameras wait for: ubimap serve {folder}/deployment.toml --open --explore");
    log::info!(
        "robots wait for: ubimap robot {folder}/robot-N.toml, each in a terminal of its own"
    );
    match options.duration {
        Some(duration) => {
            log::info!("it runs for {} s, or until Ctrl-C", duration.micros() / 1_000_000)
        }
        None => log::info!("it runs until Ctrl-C"),
    }
}

/// The robots' true poses as a table, with the wall clock's time.
fn track(stage: &RoomStage, began_at: u64) -> String {
    let mut table = String::from("unix_s,robot,x_m,y_m,heading_deg\n");
    for (robot, track) in stage.world().robots().iter().zip(stage.tracks()) {
        for (index, pose) in (0_u64..).zip(track) {
            let at = (began_at + index * TRACK_INTERVAL.micros()) as f64 / 1e6;
            let (x, y, heading) = (pose.x.metres(), pose.y.metres(), pose.heading.degrees());
            table += &format!("{at:.3},{},{x:.3},{y:.3},{heading:.2}\n", robot.id().0);
        }
    }
    table
}
