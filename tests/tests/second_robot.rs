//! The robot in Python, written from the specification, with the real server in virtual time, over a
//! line that loses, repeats, reorders and damages frames. Both agree in the end.

use std::{
    env,
    io::{BufRead, BufReader, Write},
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
};

use serde_json::{Value, json};
use ubimap_protocol::{
    frame::{Key, MAX_FRAME},
    link::Terms,
    message::{
        ParameterAction, ParameterCommand, ParameterOutcome, ParameterReport, ParameterValue, Path,
        Stop, Waypoint,
    },
    tile::{Cell, Epoch, TileId, tile_hash},
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    channel::fault::{FaultWire, Faults},
    server::{Command as Order, Policy, Server},
};
use ubimap_tests::vectors::{folder, hex, unhex};

const ROBOT: RobotId = RobotId(7);
/// By how much the robot's clock is ahead of the server's, in microseconds.
const AHEAD: u64 = 33_000_000;

/// The robot's process.
struct Python {
    child: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
}

impl Python {
    /// Starts it; `None`, and a line that says so, without Python.
    fn start() -> Option<Self> {
        let script = folder().join("../python/step_robot.py");
        let mut command = Command::new("python3");
        command.arg("-B").arg(script).stdin(Stdio::piped()).stdout(Stdio::piped());
        match command.spawn() {
            Ok(mut child) => {
                let input = child.stdin.take().unwrap();
                let output = BufReader::new(child.stdout.take().unwrap());
                Some(Self { child, input, output })
            }
            Err(error) => {
                assert!(env::var_os("CI").is_none(), "python3: {error}");
                let _ = writeln!(std::io::stderr(), "skipped: step_robot.py: no python3: {error}");
                None
            }
        }
    }

    fn step(&mut self, step: &Value) -> Value {
        writeln!(self.input, "{step}").expect("the robot in Python has ended: see above");
        let mut line = String::new();
        self.output.read_line(&mut line).unwrap();
        serde_json::from_str(&line).expect("the robot in Python has ended: see above")
    }
}

impl Drop for Python {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

struct Bench {
    server: Server,
    robot: Python,
    up: FaultWire,
    down: FaultWire,
    due: u64,
    now: u64,
    frame_size: usize,
    key: Option<[u8; 16]>,
}

/// A server with one port, which is keyed if the robot has a key.
fn server(terms: Terms, key: Option<[u8; 16]>) -> Server {
    let mut server = Server::new(terms, 0);
    let policy = key.map_or(Policy::Open, |key| {
        server.set_key(ROBOT, Key::new(key));
        Policy::Keyed
    });
    server.open_port(policy);
    server
}

/// The step with which a life of the robot begins.
fn boot(now: u64, number: u32, key: Option<[u8; 16]>) -> Value {
    let key = key.map_or(String::new(), |key| hex(&key));
    json!({ "now": now + AHEAD, "restart": number, "key": key })
}

const TERMS: Terms =
    Terms { resolution: Millimetres(50), frame: 250, server_epoch: 3, stores: false };

impl Bench {
    fn new(mut robot: Python, faults: Faults, terms: Terms, key: Option<[u8; 16]>) -> Self {
        let now = 1_000_000;
        let told = robot.step(&boot(now, 99, key));
        let (up, down) = (FaultWire::new(faults, 1), FaultWire::new(faults, 2));
        let server = server(terms, key);
        let frame_size = terms.frame.into();
        let mut bench = Self { server, robot, up, down, due: 0, now, frame_size, key };
        bench.take(&told);
        bench
    }

    fn take(&mut self, told: &Value) {
        for frame in told["frames"].as_array().unwrap() {
            let frame = unhex(frame.as_str().unwrap());
            // A hello may be longer than the agreed frame.
            let greeting = if self.key.is_some() { 64 } else { 36 };
            assert!(frame.len() <= self.frame_size.max(greeting), "{}", frame.len());
            self.up.send(Instant(self.now), &frame);
        }
        self.due = told["due"].as_u64().unwrap() - AHEAD;
    }

    fn drain(&mut self) {
        let mut out = [0; MAX_FRAME];
        while let Some(len) = self.server.poll_transmit(0, Instant(self.now), &mut out) {
            self.down.send(Instant(self.now), &out[..len]);
        }
    }

    fn run_until(&mut self, end: u64) {
        loop {
            let server = self.server.poll_timeout(0, Instant(self.now));
            let wires = [self.up.next_delivery(), self.down.next_delivery(), server];
            let next = wires.into_iter().flatten().map(|due| due.0).chain([self.due]).min();
            let next = next.unwrap().max(self.now);
            if next > end {
                break;
            }
            self.now = next;
            let now = Instant(next);
            while let Some(bytes) = self.up.poll(now) {
                self.server.receive(0, &bytes, now).unwrap();
            }
            let mut bytes = Vec::new();
            while let Some(frame) = self.down.poll(now) {
                bytes.push(hex(&frame));
            }
            if !bytes.is_empty() || self.due <= next {
                let told = self.robot.step(&json!({ "now": next + AHEAD, "bytes": bytes }));
                self.take(&told);
            }
            self.server.timeout(now);
            self.drain();
        }
        self.now = end;
    }

    /// Tenths of a second in which a camera sees the robot standing at the origin of its odometry.
    fn live(&mut self, seconds: u64) {
        for tenth in 0..10 * seconds {
            if tenth.is_multiple_of(3) {
                let robots = vec![Sighting::usual(ROBOT, Pose::from_metres(0.1, 0.2, 0.0))];
                // Free ground that comes into view and goes out of it.
                let side = (self.now / 2_000_000 % 8) as i32 + 4;
                let cells = (0..side).flat_map(|x| (0..6).map(move |y| ((x, y), Cell::Free)));
                let captured = Instant(self.now);
                let cells = cells.collect();
                let seen = Observation { captured, robots, cells, ..Observation::default() };
                self.server.observe(&seen);
                self.drain();
            }
            self.run_until(self.now + 100_000);
        }
    }

    /// Sends a command about parameters, and waits for a second. Returns the newest report.
    fn parameter(&mut self, number: u16, action: ParameterAction) -> ParameterReport {
        let command = ParameterCommand { number, action };
        self.server.command(ROBOT, Order::Parameter(command)).unwrap();
        self.live(1);
        self.server.parameters(ROBOT).unwrap().clone()
    }

    fn report(&mut self) -> Value {
        let told = self.robot.step(&json!({ "now": self.now + AHEAD, "report": true }));
        self.take(&told);
        told
    }

    /// Both sides hold the same.
    fn check(&mut self) -> Value {
        let report = self.report();
        let number = |value: &Value| value.as_i64().unwrap();
        let id = |tile: &Value| TileId { x: number(&tile[0]) as i16, y: number(&tile[1]) as i16 };
        let own = report["own"].as_array().unwrap();
        assert_eq!(own.len(), 4);
        let layer = self.server.layer(ROBOT).unwrap();
        for tile in own {
            let held = layer.held(id(tile), Epoch(number(&tile[2]) as u32));
            let (stamp, cells) = held.unwrap_or_else(|| panic!("{tile}"));
            assert_eq!(i64::from(stamp.version.0), number(&tile[3]), "{tile}");
            assert_eq!(i64::from(tile_hash(cells)), number(&tile[6]), "{tile}");
        }
        for (name, served) in [("fused", self.server.fused()), ("coverage", self.server.coverage())]
        {
            let held = report[name].as_array().unwrap();
            assert_eq!(held.len(), served.tiles().count(), "{name}");
            assert!(!held.is_empty());
            for tile in held {
                let (version, cells) = served.get(id(tile)).unwrap();
                assert_eq!(i64::from(version.0), number(&tile[2]), "{name} {tile}");
                assert_eq!((number(&tile[3]), i64::from(tile_hash(cells))), (0, number(&tile[4])));
            }
        }
        let error = number(&report["ahead"]) + AHEAD as i64;
        assert!(error.abs() <= 3_000, "the clock is {error} us off");
        report
    }

    fn codes(&self) -> Vec<u16> {
        let events = self.server.events(ROBOT).unwrap();
        events.newest().map(|it| it.event.code).collect()
    }
}

/// A line with every fault.
fn bad_line() -> Faults {
    Faults {
        loss: 0.2,
        burst: 2.0,
        duplicate: 0.05,
        reorder: 0.05,
        corrupt: 0.02,
        latency: Duration::from_millis(5),
        jitter: Duration::from_millis(10),
        ..Faults::default()
    }
}

#[test]
fn the_robot_in_python_agrees_with_the_server() {
    let Some(python) = Python::start() else { return };
    let mut bench = Bench::new(python, Faults::default(), TERMS, None);
    bench.live(8);
    bench.server.command(ROBOT, Order::Stop(Stop { number: 1, stop: true })).unwrap();
    let waypoints = [Waypoint { x: Millimetres(400), y: Millimetres(200) }].into_iter().collect();
    bench.server.command(ROBOT, Order::Path(Path { number: 1, waypoints })).unwrap();
    let set = |parameter, value| ParameterAction::Set(ParameterValue { parameter, value });
    for (number, action) in [
        (1, set(4, 50)),
        (2, set(4, 10_001)),
        (3, ParameterAction::Get(99)),
        (4, ParameterAction::List),
        (5, ParameterAction::Get(13)),
        (6, set(13, 0)),
        // It is stopped on its way.
        (7, set(13, 1)),
    ] {
        let report = bench.parameter(number, action);
        let told = (report.number, format!("{:?}", report.outcome), report.values.len());
        let (done, refused) = (("Done", 1), ("OutOfRange", 1));
        let expected = [done, refused, ("Unknown", 0), ("Done", 9), done, refused, done];
        let (outcome, values) = expected[usize::from(number) - 1];
        assert_eq!(told, (number, outcome.into(), values));
        if number >= 5 {
            assert_eq!(
                report.values[0],
                ParameterValue { parameter: 13, value: i32::from(number == 7) }
            );
        }
    }
    let report = bench.check();
    assert_eq!(report["odometry"], json!([0.0, 0.0]), "it was stopped");
    bench.parameter(8, set(4, 60));
    bench.server.command(ROBOT, Order::Stop(Stop { number: 2, stop: false })).unwrap();
    let report = bench.parameter(9, set(13, 1));
    assert_eq!(report.outcome, ParameterOutcome::OutOfRange, "it drives");
    bench.live(3);
    let report = bench.check();
    let x = report["odometry"][0].as_f64().unwrap();
    assert!((x - 300.0).abs() < 2.0, "{x}");
    assert_eq!(bench.codes(), [1, 11], "started, path done");
    assert!(report["fresh"].as_u64() > Some(0));
    for (name, count) in report["counters"].as_object().unwrap() {
        assert_eq!(count, 0, "{name}");
    }
}

#[test]
fn the_robot_in_python_agrees_over_a_bad_line_and_through_restarts() {
    let key = Some([7; 16]);
    for (frame, key) in [(250, None), (32, None), (250, key), (48, key)] {
        let Some(python) = Python::start() else { return };
        let terms = Terms { frame, ..TERMS };
        let mut bench = Bench::new(python, bad_line(), terms, key);
        bench.live(25);
        // Another life of the server.
        bench.server = server(Terms { server_epoch: 4, ..terms }, key);
        bench.live(25);
        // Another life of the robot.
        let told = bench.robot.step(&boot(bench.now, 12_345, key));
        bench.take(&told);
        bench.live(25);
        bench.up = FaultWire::new(Faults::default(), 3);
        bench.down = FaultWire::new(Faults::default(), 4);
        bench.live(12);
        bench.run_until(bench.now + 5_000_000);
        bench.check();
        assert!(bench.codes().contains(&1));
    }
}
