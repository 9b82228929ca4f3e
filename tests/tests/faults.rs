//! Faults on the ports of the unmodified image in the emulator, while it drives in the simulated room:
//! what it tells its wheels, what it tells the server, and that it goes on afterwards.

use std::{
    path::PathBuf,
    sync::{Mutex, MutexGuard, PoisonError},
    thread,
    time::{Duration, Instant},
};

use clap::Parser;
use log::{LevelFilter, Log, Metadata, Record};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_sim_host::{
    report::Report,
    run::{options::SimulateOptions, simulate},
};
use ubimap_tests::{
    emulator::{Emulator, EmulatorError, firmware, leave_out},
    faulty_line::{FaultyLine, LineState},
    wheel_commands::{WheelCommand, wheel_commands},
};

#[derive(Parser)]
struct CommandLine {
    #[command(flatten)]
    options: SimulateOptions,
}

/// The ports, in the order of [`Emulator::ports`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Port {
    Server = 0,
    Sensor = 1,
    Wheels = 2,
}

/// Time in which the wheels stand after their port or the sensor's has failed.
const STANDS: Duration = Duration::from_millis(600);

/// The same for the server's port: 2 s without a message, and as long for the last ones to arrive and
/// for a step of the drive.
const STANDS_WITHOUT_SERVER: Duration = Duration::from_millis(2_600);

/// Maximum time for a robot to drive on after a fault. People may be in its way.
const PATIENCE: Duration = Duration::from_secs(40);

/// A robot in the emulator whose lines to the simulated room can fail.
struct Rig {
    emulator: Emulator,
    lines: [FaultyLine; 3],
}

impl Rig {
    fn start() -> Result<Self, EmulatorError> {
        let emulator = Emulator::start(&firmware()?)?;
        let line = |port: &PathBuf| FaultyLine::new(port, 1);
        let [server, sensor, wheels] = emulator.ports().each_ref().map(line);
        let failed = |error| EmulatorError::Failed(format!("a pseudo-terminal: {error}"));
        let lines = [server, sensor, wheels].map(|line| line.map_err(failed));
        let [server, sensor, wheels] = lines;
        Ok(Self { emulator, lines: [server?, sensor?, wheels?] })
    }

    /// Runs the simulated room, with the robot's devices and the server, for a time.
    fn simulate(&self, seconds: u64) -> Report {
        let paths = self.lines.each_ref().map(|line| line.path().display().to_string());
        let line = ["simulate", "--robots", "1", "--ideal-cameras", "--outside", &paths.join(",")];
        let duration = seconds.to_string();
        let line = line.into_iter().chain(["--seed", "1", "--duration", &duration]);
        simulate::run(&CommandLine::parse_from(line).options).unwrap().report
    }

    fn set(&self, port: Port, state: LineState) {
        self.lines[port as usize].set(state);
    }

    /// The commands to the wheels since a moment.
    fn commands(&self, since: Instant) -> Vec<WheelCommand> {
        let mut commands = wheel_commands(&self.lines[Port::Wheels as usize].spoken());
        commands.retain(|command| command.at >= since);
        commands
    }

    /// Waits until the wheels have turned for half a second.
    #[track_caller]
    fn wait_until_it_drives(&self, after: &str) {
        let start = Instant::now();
        loop {
            let commands = self.commands(Instant::now() - Duration::from_millis(500));
            if commands.len() >= 5 && commands.iter().all(WheelCommand::moves) {
                return;
            }
            let told = messages().join("\n");
            assert!(start.elapsed() < PATIENCE, "after {after} it stands; the messages:\n{told}");
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// Disturbs a port of the driving robot, mends it, and waits until the robot drives on. Returns
    /// the time until the wheels stood, if the robot has to stop within `stands`.
    #[track_caller]
    fn disturb(&self, port: Port, state: LineState, time: Duration, stands: Option<Duration>) {
        let fault = format!("{state:?} {port:?}");
        self.wait_until_it_drives(&format!("the fault before {fault}"));
        let begin = Instant::now();
        self.set(port, state);
        thread::sleep(time);
        let commands = self.commands(begin);
        self.set(port, LineState::Whole);
        if let Some(most) = stands {
            let last = commands.iter().rev().find(|command| command.moves());
            let stood = last.map_or(Duration::ZERO, |command| command.at - begin);
            println!("| {fault} | {} ms |", stood.as_millis());
            assert!(stood <= most, "{fault}: the wheels are told to turn after {stood:?}");
            let zeros = commands.iter().filter(|command| command.at > begin + stood);
            assert!(zeros.count() >= 3, "{fault}: the wheels are not told to stand");
        }
    }
}

/// Only one emulator runs at a time, because the runs are in real time.
static ALONE: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What the server says of the robot.
struct Messages(Mutex<Vec<String>>);

static MESSAGES: Messages = Messages(Mutex::new(Vec::new()));

impl Log for Messages {
    fn enabled(&self, _: &Metadata<'_>) -> bool {
        true
    }

    fn log(&self, record: &Record<'_>) {
        let mut messages = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        messages.push(record.args().to_string());
    }

    fn flush(&self) {}
}

/// The messages since [`listen`].
fn messages() -> Vec<String> {
    MESSAGES.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

/// Forgets the messages of the tests before.
fn listen() {
    // Another test of this process may have set it.
    let _ = log::set_logger(&MESSAGES);
    log::set_max_level(LevelFilter::Debug);
    MESSAGES.0.lock().unwrap_or_else(PoisonError::into_inner).clear();
}

#[test]
#[ignore = "runs an image in the emulator: cargo real-time"]
fn the_wheels_stand_while_a_port_has_failed_and_the_map_converges() {
    let _alone = alone();
    let rig = match Rig::start() {
        Ok(rig) => rig,
        Err(error) => return leave_out("faults on the ports of the firmware", &error),
    };
    listen();
    let (cut, noise) = (Duration::from_secs(5), Duration::from_secs(1));
    // The base is switched on 5 s after the board.
    rig.set(Port::Wheels, LineState::Cut);
    let begin = Instant::now();
    println!("| fault | the last command to turn the wheels |\n|---|---|");
    let report = thread::scope(|scope| {
        let room = scope.spawn(|| rig.simulate(150));
        thread::sleep(cut);
        assert!(rig.commands(begin).iter().all(|command| !command.moves()));
        rig.set(Port::Wheels, LineState::Whole);
        rig.disturb(Port::Sensor, LineState::Cut, cut, Some(STANDS));
        rig.disturb(Port::Sensor, LineState::Noisy, noise, Some(STANDS));
        rig.disturb(Port::Server, LineState::Cut, cut, Some(STANDS_WITHOUT_SERVER));
        // A second without the server is no reason to stand.
        rig.disturb(Port::Server, LineState::Noisy, noise, None);
        rig.disturb(Port::Wheels, LineState::Noisy, noise, Some(STANDS));

        rig.wait_until_it_drives("the noise on the wheels' port");
        let begin = Instant::now();
        rig.emulator.reset().unwrap();
        thread::sleep(STANDS);
        // It may have a session again and drive on by now.
        assert!(rig.commands(begin).iter().any(|command| !command.moves()));
        rig.wait_until_it_drives("the reset");

        rig.disturb(Port::Wheels, LineState::Cut, cut, Some(STANDS));
        room.join().unwrap()
    });
    assert!(report.map.converged, "{report:?}");
    let told = messages().join("\n");
    for what in ["gets no valid scans from its sensor", "has no pose"] {
        assert!(told.contains(what), "not told: {what}; the messages:\n{told}");
    }
}

#[test]
#[ignore = "runs an image in the emulator: cargo real-time"]
fn a_robot_goes_on_with_the_next_server() {
    let _alone = alone();
    let rig = match Rig::start() {
        Ok(rig) => rig,
        Err(error) => return leave_out("the next server of the firmware", &error),
    };
    listen();
    rig.simulate(12);
    // The server is gone, and the sensor and the base are switched off.
    let gone = Instant::now();
    thread::sleep(Duration::from_secs(5));
    let commands = rig.commands(gone);
    let last = commands.iter().rev().find(|command| command.moves());
    let stood = last.map_or(Duration::ZERO, |command| command.at - gone);
    assert!(stood <= STANDS, "the wheels are told to turn after {stood:?}");
    let begin = Instant::now();
    let report = thread::scope(|scope| {
        let room = scope.spawn(|| rig.simulate(40));
        rig.wait_until_it_drives("the restart of the server");
        room.join().unwrap()
    });
    assert!(report.map.converged, "{report:?}");
    assert!(rig.commands(begin).iter().any(WheelCommand::moves));
}

/// Random faults for a minute, or for `UBIMAP_FAULT_MINUTES`: the robot answers afterwards, in the same
/// session, and holds the same map as the server.
#[test]
#[ignore = "runs an image in the emulator: cargo real-time"]
fn random_faults_do_not_reset_the_robot() {
    let _alone = alone();
    let rig = match Rig::start() {
        Ok(rig) => rig,
        Err(error) => return leave_out("random faults on the ports of the firmware", &error),
    };
    listen();
    let minutes = std::env::var("UBIMAP_FAULT_MINUTES").map_or(1, |said| said.parse().unwrap());
    let seconds = minutes * 60;
    let report = thread::scope(|scope| {
        let room = scope.spawn(|| rig.simulate(seconds + 20));
        rig.wait_until_it_drives("the start");
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let end = Instant::now() + Duration::from_secs(seconds);
        while Instant::now() < end {
            let port = [Port::Server, Port::Sensor, Port::Wheels][rng.random_range(0..3)];
            let state = [LineState::Cut, LineState::Noisy][rng.random_range(0..2)];
            rig.set(port, state);
            thread::sleep(Duration::from_millis(rng.random_range(20..1_200)));
            rig.set(port, LineState::Whole);
            thread::sleep(Duration::from_millis(rng.random_range(100..2_000)));
        }
        room.join().unwrap()
    });
    assert!(report.map.converged, "{report:?}");
    let told = messages();
    let started = told.iter().filter(|message| message.contains("has started")).count();
    assert!(started <= 1, "it was reset; the messages:\n{}", told.join("\n"));
}
