//! `ubimap` as a service manager and a careless hand meet it: signals, and adapters that are pulled
//! out and put back.
#![cfg(target_os = "linux")]

use std::{
    io::{BufRead, BufReader, Read, Write},
    os::unix::fs::symlink,
    path::{Path, PathBuf},
    process::{Child, ChildStderr, Command, Output, Stdio},
    thread, time,
};

use nix::{
    fcntl::OFlag,
    pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt},
};
use ubimap_agent::{Bounds, Config, Memory, Robot, sense::SensorModel};
use ubimap_protocol::{time::Instant, units::RobotId};
use ubimap_sim_host::run::heap::{BOUNDS, Heap};

const PATIENCE: time::Duration = time::Duration::from_secs(60);

/// A new folder for the files of a test.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

fn start(folder: &Path, arguments: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
    command.current_dir(folder).env_remove("RUST_LOG").args(arguments);
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

fn signal(child: &Child, name: &str) {
    let sent = Command::new("kill").args([name, &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
}

/// A robot that maps nothing, behind a pseudo-terminal.
struct Bench<'b> {
    robot: Robot<'b>,
    port: Option<PtyMaster>,
    started: time::Instant,
}

fn memory() -> (Config, Memory<Heap>) {
    let model = SensorModel::Radial { first: -3.0, step: 0.1 };
    let bounds = Bounds { readings: 60, fused_tiles: 16, max_range: 1_400, ..BOUNDS };
    (Config::new(RobotId(1), model, bounds), Memory::new(&bounds))
}

impl Bench<'_> {
    fn turn(&mut self) {
        let now = Instant(self.started.elapsed().as_micros() as u64);
        let mut buffer = [0; 1_024];
        match self.port.as_mut().map(|port| port.read(&mut buffer)) {
            Some(Ok(count)) => self.robot.receive(&buffer[..count], now),
            _ => thread::sleep(time::Duration::from_millis(1)),
        }
        self.robot.timeout(now);
        while let Some(len) = self.robot.poll_transmit(now, &mut buffer) {
            let _ = self.port.as_mut().map(|port| port.write_all(&buffer[..len]));
        }
    }

    #[track_caller]
    fn turn_until(&mut self, what: &str, mut done: impl FnMut(&Robot<'_>) -> bool) {
        let began = time::Instant::now();
        while !done(&self.robot) {
            assert!(began.elapsed() < PATIENCE, "timeout while waiting until {what}");
            self.turn();
        }
    }
}

/// A pseudo-terminal whose far end is reached through a symbolic link, as an adapter is through
/// udev's.
fn plug_in(link: &Path) -> PtyMaster {
    // Closed in the server, which would otherwise hold this end too: then the port never hangs up.
    let flags = OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_NONBLOCK | OFlag::O_CLOEXEC;
    let master = posix_openpt(flags).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let _ = std::fs::remove_file(link);
    symlink(ptsname_r(&master).unwrap(), link).unwrap();
    master
}

/// Waits for a line with `part`.
fn await_line(lines: &mut BufReader<ChildStderr>, part: &str) {
    let mut line = String::new();
    while !line.contains(part) {
        line.clear();
        assert_ne!(lines.read_line(&mut line).unwrap(), 0, "no line with {part:?}");
    }
}

#[test]
fn a_port_that_comes_back_is_served_again_and_a_signal_ends_the_service_in_order() {
    let folder = folder("service");
    let link = folder.join("port");
    let port = Some(plug_in(&link));
    let mut child = start(&folder, &["serve", "--store", "map.db", "--pose", "1,2,3", "port"]);
    let mut lines = BufReader::new(child.stderr.take().unwrap());
    let (config, mut memory) = memory();
    let robot = Robot::new(config, &mut memory).unwrap();
    let mut bench = Bench { robot, port, started: time::Instant::now() };
    bench.turn_until("the robot has a pose", |robot| robot.pose().is_some());

    // The only port hangs up, and its name leads nowhere for a while.
    std::fs::remove_file(&link).unwrap();
    bench.port = None;
    await_line(&mut lines, "port: disconnected");
    thread::sleep(time::Duration::from_millis(1_500));
    bench.port = Some(plug_in(&link));
    await_line(&mut lines, "port: connected again");
    let met = bench.robot.statistics().sessions;
    bench.turn_until("the robot has another session", |robot| {
        robot.is_connected() && robot.statistics().sessions > met
    });
    assert!(!bench.robot.commands().must_stop());

    signal(&child, "-TERM");
    bench.turn_until("the robot is told to stop", |robot| robot.commands().must_stop());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0));
    let report = String::from_utf8(output.stdout).unwrap();
    assert!(report.contains("port: robot 1; its own last report: at 1.000 m, 2.000 m"), "{report}");
    assert!(!folder.join("map.db-wal").exists(), "the store was not closed");
}

/// Interrupts a run after a second.
fn interrupted(folder: &Path, arguments: &[&str], name: &str) -> Output {
    let child = start(folder, arguments);
    thread::sleep(time::Duration::from_secs(1));
    signal(&child, name);
    child.wait_with_output().unwrap()
}

#[test]
fn an_interrupted_run_writes_its_results_so_far() {
    let folder = folder("interrupted");
    let run = ["simulate", "--ideal-cameras", "--duration", "1000000", "--store", "map.db"];
    for name in ["-INT", "-TERM"] {
        let output = interrupted(&folder, &run, name);
        let words = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(0), "{words}");
        assert!(words.contains("interrupted: "), "{words}");
        let report = String::from_utf8(output.stdout).unwrap();
        assert!(report.contains("results:   in ubimap-out"), "{report}");
        assert!(folder.join("ubimap-out/map.png").exists());
        assert!(!folder.join("map.db-wal").exists(), "the store was not closed");
        std::fs::remove_dir_all(folder.join("ubimap-out")).unwrap();
    }
}
