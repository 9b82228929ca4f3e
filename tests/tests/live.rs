//! The whole system as real processes: `ubimap rig` as the outside world, `ubimap serve` with its cameras, the
//! firmware in the emulator as robot 1, and `ubimap robot` over UDP as robots 2 and 3.
//!
//! In real time, so it wants a machine with little else to do: `cargo live`. It runs the program that is built
//! beside the test.
#![cfg(target_os = "linux")]

use std::{
    collections::BTreeMap,
    env, fs,
    net::UdpSocket,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    thread,
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use serde_json::Value;
use ubimap_tests::{
    emulator::{Emulator, firmware, leave_out},
    lossy_network::LossyNetwork,
    stream_relay::StreamRelay,
};

/// How long a process may take to end, or to do what is waited for.
const PATIENCE: Duration = Duration::from_secs(60);
/// Interval between two looks at the poses that the server knows.
const LOOK_INTERVAL: Duration = Duration::from_millis(250);
/// Where the robots are called back to, within the cameras' view.
const HOMES: [(u16, [f64; 2]); 3] = [(1, [0.9, 1.2]), (2, [1.2, 2.6]), (3, [2.2, 2.2])];
/// Time after the last frame of the server within which a robot must stand: it waits 2 s and brakes.
const BRAKES: f64 = 3.0;

/// The program, built beside this test.
fn ubimap() -> Command {
    let test = env::current_exe().unwrap();
    let program = test.ancestors().nth(2).unwrap().join("ubimap");
    assert!(program.exists(), "{} is missing: run `cargo live`", program.display());
    Command::new(program)
}

fn unix_s() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64()
}

/// A process of the system; killed if the test fails.
struct Process(Option<Child>);

impl Process {
    fn kill(mut self) {
        let mut child = self.0.take().unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// Ends it in order. Returns what it has printed.
    fn end(mut self) -> String {
        let child = self.0.take().unwrap();
        let id = child.id().to_string();
        assert!(Command::new("kill").args(["-TERM", &id]).status().unwrap().success());
        let output = child.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(0));
        String::from_utf8(output.stdout).unwrap()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if let Some(child) = &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// A robot's pose as the server knew it: x and y in metres, heading in degrees.
struct Told {
    /// When the server's clock was zero, in seconds since 1970.
    zero: f64,
    /// The pose's time by that clock.
    time: f64,
    robot: u16,
    pose: [f64; 3],
}

/// All processes but the server.
struct System {
    folder: PathBuf,
    network: LossyNetwork,
    camera: StreamRelay,
    rig: Process,
    _emulator: Emulator,
    told: Vec<Told>,
}

impl System {
    /// Starts the rig, and the emulator, in a new folder. `None` without an emulator.
    fn start(name: &str, rig: &[&str]) -> Option<Self> {
        let image = match firmware() {
            Ok(image) => image,
            Err(error) => {
                leave_out(name, &error);
                return None;
            }
        };
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).unwrap();
        let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let network = LossyNetwork::new(free, 1).unwrap();
        let camera = StreamRelay::new(&folder.join("camera-00.sock"), &folder.join("relayed.sock"));
        let scenario =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../sim-host/scenarios/corner.toml");
        let (scenario, port) = (scenario.to_str().unwrap(), free.to_string());
        let usual = ["rig", scenario, "--folder", ".", "--port", &port, "--json"];
        let scores = ["--map", "ubimap-out/map.yaml", "--track", "track.csv"];
        let arguments = [&usual[..], &scores[..], rig].concat();
        let rig = process(&folder, "rig.log", &arguments);
        wait_for("the rig's files", || folder.join("robot-3.toml").exists());
        let device = |name: &str| folder.join(format!("robot-1-{name}"));
        let emulator = Emulator::start_between(&image, &device("sensor"), &device("wheels"));
        let emulator = emulator.unwrap();

        // As a user edits the files: robot 1 is at a serial port, the others reach the server by a bad network,
        // and the first camera by a relay.
        let edit = |file: &str, from: &str, to: &str| {
            let text = fs::read_to_string(folder.join(file)).unwrap();
            assert!(text.contains(from), "{file}: {text}");
            fs::write(folder.join(file), text.replace(from, to)).unwrap();
        };
        let serial = emulator.ports()[0].display();
        let udp = format!("\"udp:{port}\"");
        edit("deployment.toml", &udp, &format!("{udp}, \"{serial}\""));
        edit("deployment.toml", "stream:camera-00.sock", "stream:relayed.sock");
        for robot in [2, 3] {
            edit(&format!("robot-{robot}.toml"), &udp, &format!("\"udp:{}\"", network.address()));
        }
        let (camera, told) = (camera.unwrap(), Vec::new());
        Some(Self { folder, network, camera, rig, _emulator: emulator, told })
    }

    fn serve(&self) -> Process {
        let arguments = ["serve", "deployment.toml", "--open", "--explore", "--json"];
        let server = process(&self.folder, "serve.log", &arguments);
        wait_for("the server", || self.ask(&["status"]).is_some());
        server
    }

    fn robot(&self, number: u16) -> Process {
        let name = format!("robot-{number}");
        process(&self.folder, &format!("{name}.log"), &["robot", &format!("{name}.toml")])
    }

    /// The answer of the running server.
    fn ask(&self, arguments: &[&str]) -> Option<String> {
        let output = ubimap().current_dir(&self.folder).args(arguments).output().unwrap();
        if !output.status.success() {
            print!("{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
        }
        output.status.success().then(|| String::from_utf8(output.stdout).unwrap())
    }

    /// Lets time pass, and keeps the poses that the server knows.
    fn follow(&mut self, seconds: u64) {
        let end = Instant::now() + Duration::from_secs(seconds);
        while Instant::now() < end {
            thread::sleep(LOOK_INTERVAL);
            let Some(answer) = self.ask(&["status", "--json"]) else { continue };
            let report: Value = serde_json::from_str(&answer).unwrap();
            let seconds = |key: &str| report[key].as_f64().unwrap();
            let zero = seconds("unix_s") - seconds("time_s");
            for (robot, time, pose) in poses(&report) {
                self.told.push(Told { zero, time, robot, pose });
            }
        }
    }

    /// The area that the server's map knows, in square metres.
    fn known_m2(&self) -> f64 {
        let answer = self.ask(&["status", "--json"]).expect("a running server");
        let report: Value = serde_json::from_str(&answer).unwrap();
        let map = &report["map"];
        map["known"].as_f64().unwrap() * map["resolution_m"].as_f64().unwrap().powi(2)
    }

    /// Writes the poses told beside the rig's `track.csv`, in the same form.
    fn write_told(&self) {
        let rows = self.told.iter().map(|&Told { zero, time, robot, pose: [x, y, heading] }| {
            format!("{:.3},{robot},{x:.4},{y:.4},{heading:.3}\n", zero + time)
        });
        let table = String::from("unix_s,robot,x_m,y_m,heading_deg\n") + &rows.collect::<String>();
        fs::write(self.folder.join("told.csv"), table).unwrap();
    }

    /// Whether no robot is on its way.
    fn is_idle(&self) -> bool {
        let Some(answer) = self.ask(&["status", "--json"]) else { return false };
        let report: Value = serde_json::from_str(&answer).unwrap();
        let robots = report["robots"].as_array().unwrap();
        robots.iter().all(|robot| robot["doing"] == "has nothing to do")
    }

    /// Calls the robots back into the cameras' view, stops them, ends all processes and compares the results
    /// with the truth.
    fn finish(mut self, server: Process, robots: Vec<Process>) -> Results {
        // Robots that explore would go on when they are there.
        self.ask(&["stop"]).unwrap();
        for (robot, [x, y]) in HOMES {
            let (robot, [x, y]) = (robot.to_string(), [x, y].map(|metres| metres.to_string()));
            let goes = || self.ask(&["go", &robot, &x, &y]).is_some();
            wait_for(&format!("robot {robot} to turn back"), goes);
        }
        let began = Instant::now();
        while began.elapsed() < PATIENCE && !self.is_idle() {
            self.follow(1);
        }
        println!("the robots are back after {:.0} s", began.elapsed().as_secs_f64());
        self.ask(&["stop"]).unwrap();
        // They brake, and report where they stand.
        self.follow(5);
        self.write_told();
        let report: Value = serde_json::from_str(&server.end()).unwrap();
        robots.into_iter().for_each(|robot| drop(robot.end()));
        let truth: Value = serde_json::from_str(&self.rig.end()).unwrap();
        let track = Track::read(&self.folder.join("track.csv"));
        let last = poses(&report).map(|(robot, _, pose)| (robot, pose));
        let stands = last.map(|(robot, pose)| off(pose, track.last(robot))).collect();
        let results = Results {
            f1: truth["truth"]["f1_occupied"].as_f64().unwrap(),
            collisions: truth["collisions"].as_u64().unwrap(),
            late_ms: truth["late_ms"].as_u64().unwrap(),
            stands,
            driven: rms(&self.told, &track),
            track,
        };
        println!("{report}\n{truth}");
        results.print();
        results
    }
}

/// The newest poses of a report's robots, except those that the server seeks: number, server's time, and pose.
fn poses(report: &Value) -> impl Iterator<Item = (u16, f64, [f64; 3])> {
    let robots = report["robots"].as_array().unwrap();
    let is_sought = |number: &Value| {
        robots.iter().any(|robot| robot["robot"] == *number && robot["is_sought"] == true)
    };
    let ports = report["ports"].as_array().unwrap().iter();
    let is_known = move |port: &&Value| port["session"] == true && !is_sought(&port["robot"]);
    ports.filter(is_known).filter_map(|port| {
        let state = &port["state"];
        let pose = state["pose"].as_array()?;
        let pose = [0, 1, 2].map(|axis| pose[axis].as_f64().unwrap());
        Some((port["robot"].as_u64()? as u16, state["time_s"].as_f64()?, pose))
    })
}

/// The differences of two poses in metres and degrees.
fn off(pose: [f64; 3], truth: [f64; 3]) -> [f64; 2] {
    let turn = (pose[2] - truth[2] + 540.0).rem_euclid(360.0) - 180.0;
    [(pose[0] - truth[0]).hypot(pose[1] - truth[1]), turn.abs()]
}

/// Root mean squares of the errors of poses told, in metres and degrees.
fn rms(told: &[Told], track: &Track) -> [f64; 2] {
    let (mut sums, mut count) = ([0.0; 2], 0.0);
    for &Told { zero, time, robot, pose } in told {
        if let Some(truth) = track.at(robot, zero + time) {
            let off = off(pose, truth);
            (0..2).for_each(|axis| sums[axis] += off[axis].powi(2));
            count += 1.0;
        }
    }
    sums.map(|sum| (sum / count).sqrt())
}

/// The true poses, with the times at which they were true.
struct Track(BTreeMap<u16, Vec<(f64, [f64; 3])>>);

impl Track {
    fn read(path: &Path) -> Self {
        let mut robots = BTreeMap::<u16, Vec<_>>::new();
        for line in fs::read_to_string(path).unwrap().lines().skip(1) {
            let row: Vec<f64> = line.split(',').map(|it| it.parse().unwrap()).collect();
            let [time, robot, x, y, heading] = row[..] else { panic!("{line}") };
            robots.entry(robot as u16).or_default().push((time, [x, y, heading]));
        }
        Self(robots)
    }

    fn last(&self, robot: u16) -> [f64; 3] {
        self.0[&robot].last().unwrap().1
    }

    /// The pose at a time, interpolated.
    fn at(&self, robot: u16, time: f64) -> Option<[f64; 3]> {
        let rows = &self.0[&robot];
        let next = rows.partition_point(|row| row.0 <= time);
        let (from, to) = (rows.get(next.checked_sub(1)?)?, rows.get(next)?);
        let part = (time - from.0) / (to.0 - from.0);
        let turn = (to.1[2] - from.1[2] + 540.0).rem_euclid(360.0) - 180.0;
        let mix = |axis: usize| from.1[axis] + part * (to.1[axis] - from.1[axis]);
        Some([mix(0), mix(1), from.1[2] + part * turn])
    }

    /// The longest way that a robot made between two times, in metres.
    fn way_m(&self, from: f64, to: f64) -> f64 {
        let ways = self.0.keys().map(|&robot| {
            let within = self.0[&robot].iter().filter(|row| (from..=to).contains(&row.0));
            let places: Vec<[f64; 3]> = within.map(|row| row.1).collect();
            places.windows(2).map(|pair| off(pair[0], pair[1])[0]).sum()
        });
        ways.fold(0.0, f64::max)
    }
}

struct Results {
    f1: f64,
    collisions: u64,
    late_ms: u64,
    /// For each robot, in metres and degrees, where it stands at the end.
    stands: Vec<[f64; 2]>,
    /// Root mean squares over the whole run, in metres and degrees.
    driven: [f64; 2],
    track: Track,
}

impl Results {
    fn print(&self) {
        let Self { f1, collisions, late_ms, stands, driven, .. } = self;
        println!(
            "| F1 {f1:.3} | {collisions} collisions | poses at the end {stands:.3?} | RMS while driving \
             {driven:.3?} | the room late by up to {late_ms} ms |"
        );
    }

    /// Checks the bounds.
    #[track_caller]
    fn check(&self) {
        assert!(self.f1 >= 0.97, "F1 {}", self.f1);
        assert_eq!(self.collisions, 0);
        assert_eq!(self.stands.len(), HOMES.len());
        for &[off_m, off_deg] in self.stands.iter().chain([&self.driven]) {
            assert!(off_m <= 0.02 && off_deg <= 1.0, "{:?}, {:?}", self.stands, self.driven);
        }
    }
}

fn process(folder: &Path, log: &str, arguments: &[&str]) -> Process {
    let log = fs::OpenOptions::new().create(true).append(true).open(folder.join(log));
    let mut command = ubimap();
    command.current_dir(folder).env_remove("RUST_LOG").args(arguments);
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(log.unwrap());
    Process(Some(command.spawn().unwrap()))
}

#[track_caller]
fn wait_for(what: &str, is_there: impl Fn() -> bool) {
    let began = Instant::now();
    while !is_there() {
        assert!(began.elapsed() < PATIENCE, "timeout while waiting for {what}");
        thread::sleep(Duration::from_millis(200));
    }
}

#[test]
#[ignore = "takes two minutes of real time, and an emulator: cargo live"]
fn robots_explore_what_the_cameras_do_not_see() {
    let Some(mut system) = System::start("live", &[]) else { return };
    let server = system.serve();
    let robots = vec![system.robot(2), system.robot(3)];
    system.follow(95);
    println!("{:.1} m2 known", system.known_m2());
    system.finish(server, robots).check();
}

/// All that happens to a system, one after the other: a camera's stream is cut, the server is killed, a robot is
/// killed, the network is bad, the cameras' clock is set by an hour.
#[test]
#[ignore = "takes three minutes of real time, and an emulator: cargo live"]
fn a_system_survives_its_parts() {
    let Some(mut system) = System::start("live-faults", &["--set-clock", "105:3600"]) else {
        return;
    };
    let server = system.serve();
    let mut robots = vec![system.robot(2), system.robot(3)];
    system.follow(30);

    let in_view = |system: &System| {
        let report: Value =
            serde_json::from_str(&system.ask(&["status", "--json"]).unwrap()).unwrap();
        (
            report["cameras"][0]["away"].as_bool().unwrap(),
            report["map"]["in_view"].as_u64().unwrap(),
        )
    };
    let (_, whole) = in_view(&system);
    system.camera.cut(true);
    system.follow(4);
    let (is_away, less) = in_view(&system);
    assert!(is_away && less < whole, "{less} of {whole} cells in view");
    system.camera.cut(false);
    let back = Instant::now();
    wait_for("the camera", || !in_view(&system).0);
    println!("the camera is back after {:.1} s", back.elapsed().as_secs_f64());
    assert!(back.elapsed() < Duration::from_secs(2));
    system.follow(8);

    let known = system.known_m2();
    server.kill();
    let killed = unix_s();
    thread::sleep(Duration::from_secs(6));
    let restarted = unix_s();
    let server = system.serve();
    let restored = system.known_m2();
    println!("{known:.2} m2 known before the server was killed, {restored:.2} m2 after");
    assert!(restored >= 0.98 * known);
    system.follow(15);

    // Started again as soon as a service manager would.
    robots.remove(0).kill();
    thread::sleep(Duration::from_secs(1));
    robots.insert(0, system.robot(2));
    system.follow(12);

    system.network.set_bad(true);
    // The cameras' clock is set meanwhile.
    system.follow(30);
    system.network.set_bad(false);
    system.follow(8);
    let report: Value = serde_json::from_str(&system.ask(&["status", "--json"]).unwrap()).unwrap();
    for camera in report["cameras"].as_array().unwrap() {
        assert_eq!((&camera["clock_jumps"], &camera["away"]), (&1.into(), &false.into()));
    }

    let results = system.finish(server, robots);
    results.check();
    let rolled = results.track.way_m(killed + BRAKES, restarted);
    let before = results.track.way_m(killed - BRAKES, killed);
    println!("{before:.3} m driven just before the server was killed, {rolled:.3} m without it");
    assert!(rolled < 0.005);
}
