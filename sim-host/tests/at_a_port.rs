//! `ubimap ports`, `monitor`, `param`, `sensor` and `wheels` as processes, against `ubimap robot` and `ubimap rig`.
#![cfg(target_os = "linux")]

use std::{
    fs,
    io::{Read, Write},
    net::UdpSocket,
    path::{Path, PathBuf},
    process::{Child, Command, Output, Stdio},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use nix::{
    fcntl::OFlag,
    pty::{PtyMaster, grantpt, posix_openpt, ptsname_r, unlockpt},
};
use serde_json::Value;

/// A new folder for the files of a test.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    folder
}

fn ubimap(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
    command.current_dir(folder).env_remove("RUST_LOG").args(arguments).stdin(Stdio::null());
    command
}

/// Runs a command to its end.
fn run(folder: &Path, arguments: &[&str]) -> Output {
    ubimap(folder, arguments).output().unwrap()
}

/// What a command that succeeds prints.
#[track_caller]
fn printed(folder: &Path, arguments: &[&str]) -> String {
    let output = run(folder, arguments);
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{arguments:?}: {errors}");
    String::from_utf8(output.stdout).unwrap()
}

/// Checks an exit code, and the one line on standard error.
#[track_caller]
fn refused(folder: &Path, arguments: &[&str], code: i32, expected: &str) {
    let output = run(folder, arguments);
    let words = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {words}");
    assert!(words.starts_with("ubimap: ") && words.contains(expected), "{words}");
    assert_eq!(words.lines().count(), 1, "{words}");
}

/// A process that runs beside a test; it is ended with it.
struct Beside(Child);

impl Beside {
    fn start(folder: &Path, arguments: &[&str]) -> Self {
        let mut command = ubimap(folder, arguments);
        command.stdout(Stdio::piped()).stderr(Stdio::null());
        Self(command.spawn().unwrap())
    }

    /// Ends it by a signal. Returns its exit code and what it has printed.
    fn end(mut self, signal: &str) -> (Option<i32>, String) {
        let id = self.0.id().to_string();
        assert!(Command::new("kill").args([signal, &id]).status().unwrap().success());
        let mut printed = String::new();
        self.0.stdout.take().unwrap().read_to_string(&mut printed).unwrap();
        (self.0.wait().unwrap().code(), printed)
    }
}

impl Drop for Beside {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A pseudo-terminal: its near end, and the name of the far one.
fn terminal() -> (PtyMaster, String) {
    let flags = OFlag::O_RDWR | OFlag::O_NOCTTY | OFlag::O_NONBLOCK | OFlag::O_CLOEXEC;
    let master = posix_openpt(flags).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let name = ptsname_r(&master).unwrap();
    (master, name)
}

/// A serial cable between two programs, each at a pseudo-terminal.
struct Cable {
    ends: [String; 2],
    is_cut: Arc<AtomicBool>,
}

impl Cable {
    fn new() -> Self {
        let ([a, b], is_cut) = ([terminal(), terminal()], Arc::new(AtomicBool::new(false)));
        let ends = [a.1, b.1];
        // Both far ends stay open, so that the near ones do not hang up.
        let held = ends.each_ref().map(|name| {
            use std::os::unix::fs::OpenOptionsExt;
            let flags = OFlag::O_NOCTTY.bits();
            let file = fs::OpenOptions::new().read(true).write(true).custom_flags(flags).open(name);
            let port = file.unwrap();
            // Raw: every byte passes as it is.
            let mut settings = nix::sys::termios::tcgetattr(&port).unwrap();
            nix::sys::termios::cfmakeraw(&mut settings);
            let now = nix::sys::termios::SetArg::TCSANOW;
            nix::sys::termios::tcsetattr(&port, now, &settings).unwrap();
            port
        });
        let (mut a, mut b) = (a.0, b.0);
        thread::spawn({
            let is_cut = Arc::clone(&is_cut);
            move || {
                let _held = held;
                let mut bytes = [0; 512];
                while !is_cut.load(Ordering::Relaxed) {
                    if let Ok(count) = a.read(&mut bytes) {
                        let _ = b.write_all(&bytes[..count]);
                    }
                    if let Ok(count) = b.read(&mut bytes) {
                        let _ = a.write_all(&bytes[..count]);
                    }
                    thread::sleep(Duration::from_millis(1));
                }
            }
        });
        Self { ends, is_cut }
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.is_cut.store(true, Ordering::Relaxed);
    }
}

/// Starts the program of a robot without devices, behind a cable. Returns the cable and its end.
fn robot(folder: &Path, id: u16) -> (Cable, Beside, String) {
    let cable = Cable::new();
    let [robot, ours] = cable.ends.clone();
    let file =
        format!("id = {id}\nserver = \"{robot}\"\nsensor = \"none-1\"\nwheels = \"none-2\"\n");
    fs::write(folder.join("robot.toml"), file).unwrap();
    (cable, Beside::start(folder, &["robot", "robot.toml"]), ours)
}

#[test]
fn ports_tells_robots_other_devices_silence_and_unusable_ports_apart() {
    let folder = folder("ports");
    let (_cable, _robot, port) = robot(&folder, 0);
    let ((_silent, silent), (mut noisy, noise)) = (terminal(), terminal());
    let is_over = Arc::new(AtomicBool::new(false));
    thread::spawn({
        let is_over = Arc::clone(&is_over);
        move || {
            while !is_over.load(Ordering::Relaxed) {
                let _ = noisy.write_all(b"$GPGGA,123519,4807.038,N\r\n");
                thread::sleep(Duration::from_millis(100));
            }
        }
    });
    let began = Instant::now();
    let named = ["ports", &port, &silent, &noise, "/dev/null", "/dev/nowhere"];
    let text = printed(&folder, &named);
    assert!(began.elapsed() < Duration::from_secs(8), "{:?}", began.elapsed());
    let lines: Vec<&str> = text.lines().collect();
    for (line, told) in [
        (0, "robot 0 (number 0: its image was not provisioned"),
        (0, "protocol version 1, boot "),
        (1, "silent"),
        (2, "bytes that are not a robot's"),
        (3, "not a serial port"),
        (4, "No such file or directory"),
    ] {
        assert!(lines[line].contains(told), "{text}");
    }
    is_over.store(true, Ordering::Relaxed);
    // A robot that comes by UDP.
    let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let file =
        format!("id = 9\nserver = \"udp:{free}\"\nsensor = \"none-1\"\nwheels = \"none-2\"\n");
    fs::write(folder.join("robot-9.toml"), file).unwrap();
    let _robot_9 = Beside::start(&folder, &["robot", "robot-9.toml"]);
    let text = printed(&folder, &["ports", &format!("udp:{free}")]);
    assert!(text.contains("robot 9, protocol version 1"), "{text}");
    let report: Value =
        serde_json::from_str(&printed(&folder, &["ports", &port, "--json"])).unwrap();
    let robot = &report["ports"][0]["heard"]["robot"];
    assert_eq!((&robot["robot"], &robot["versions"]), (&0.into(), &serde_json::json!([1, 1])));
}

#[test]
fn a_robot_is_monitored_and_its_parameters_are_read_and_set() {
    let folder = folder("monitor");
    let (_cable, _robot, port) = robot(&folder, 7);
    let text = printed(&folder, &["monitor", &port, "--json", "--duration", "2.5"]);
    let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let of = |what: &str| lines.iter().filter(|line| line["what"] == what).count();
    assert!(of("session") == 1 && of("state") >= 1 && of("link") >= 1, "{text}");
    assert!(lines.iter().any(|line| line["robot"] == 7), "{text}");

    // It has a session now, of a server that is gone: it is found all the same.
    let text = printed(&folder, &["ports", &port]);
    assert!(text.contains(": robot 7, protocol version 1"), "{text}");

    let list = printed(&folder, &["param", &port, "list"]);
    assert_eq!(list.lines().count(), 13, "{list}");
    assert!(list.contains("mounting-x") && list.contains("100 mm"), "{list}");
    let set = printed(&folder, &["param", &port, "set", "mounting-heading", "-2.5"]);
    assert!(set.starts_with("mounting-heading = -2.50 degrees"), "{set}");
    let get = printed(&folder, &["param", &port, "get", "mounting-heading"]);
    assert!(get.starts_with("mounting-heading = -2.50 degrees"), "{get}");
    let json = printed(&folder, &["param", &port, "list", "--json"]);
    let all: Value = serde_json::from_str(&json).unwrap();
    // As the robot reports it.
    assert_eq!((&all[2]["name"], &all[2]["raw"]), (&"mounting-heading".into(), &65_081.into()));
    // Before anything is sent.
    refused(&folder, &["param", "/dev/null", "set", "hold", "1e9"], 2, "0 to 60000 ms");
    refused(&folder, &["param", "/dev/null", "get", "speed"], 2, "there are mounting-x");

    // Until Ctrl-C, in order.
    let monitor = Beside::start(&folder, &["monitor", &port]);
    thread::sleep(Duration::from_secs(3));
    let (code, text) = monitor.end("-INT");
    assert_eq!(code, Some(0));
    assert!(text.contains("robot 7 has a session") && !text.contains('\u{1b}'), "{text}");

    // What it changes for a while is as before when a signal ends it.
    let sensor = Beside::start(&folder, &["sensor", &port, "--plain"]);
    thread::sleep(Duration::from_secs(6));
    assert_eq!(sensor.end("-INT").0, Some(0));
    let get = printed(&folder, &["param", &port, "get", "gate-distance"]);
    assert!(get.starts_with("gate-distance = 35 mm"), "{get}");
    // One that is killed can't do that: the next one says so, and does it.
    let sensor = Beside::start(&folder, &["sensor", &port, "--plain"]);
    thread::sleep(Duration::from_secs(6));
    assert_eq!(sensor.end("-KILL").0, None);
    let get = printed(&folder, &["param", &port, "get", "gate-distance"]);
    assert!(get.starts_with("gate-distance = 0 mm"), "{get}");
    let next = run(&folder, &["sensor", &port, "--plain", "--duration", "1"]);
    let words = String::from_utf8(next.stderr).unwrap();
    assert!(words.contains("gate-distance was 0 mm, as a killed"), "{words}");
    let get = printed(&folder, &["param", &port, "get", "gate-distance"]);
    assert!(get.starts_with("gate-distance = 35 mm"), "{get}");
}

#[test]
fn stored_parameters_are_there_at_the_next_start() {
    let folder = folder("stored");
    let (_cable, robot, port) = robot(&folder, 7);
    printed(&folder, &["param", &port, "set", "mounting-heading", "-2.5"]);
    let is_stored = |expected: &str| {
        let get = printed(&folder, &["param", &port, "get", "stored"]);
        assert!(get.starts_with(&format!("stored = {expected} ")), "{get}");
    };
    is_stored("no");
    let store = printed(&folder, &["param", &port, "store"]);
    assert!(store.starts_with("stored: the next boots of robot 7"), "{store}");
    is_stored("yes");
    let store = printed(&folder, &["param", &port, "store"]);
    assert!(store.contains("nothing differs"), "{store}");
    let file = fs::read_to_string(folder.join("robot.parameters")).unwrap();
    assert!(file.ends_with("\nmounting-heading = 65081\n"), "{file}");
    printed(&folder, &["param", &port, "set", "hold", "300"]);
    drop(robot);
    // Its next start begins with what was stored.
    let _robot = Beside::start(&folder, &["robot", "robot.toml"]);
    let list = printed(&folder, &["param", &port, "list"]);
    assert!(list.contains("-2.50 degrees") && list.contains(" 1000 ms "), "{list}");
    is_stored("yes");
    // A folder in the file's place: it can't be written.
    fs::remove_file(folder.join("robot.parameters")).unwrap();
    fs::create_dir(folder.join("robot.parameters")).unwrap();
    printed(&folder, &["param", &port, "set", "hold", "300"]);
    refused(&folder, &["param", &port, "store"], 1, "has not stored its parameters");
    is_stored("no");
    // As a killed `ubimap sensor` leaves it.
    printed(&folder, &["param", &port, "set", "gate-distance", "0"]);
    refused(&folder, &["param", &port, "store"], 1, "gate-distance is 0 mm");
    refused(&folder, &["param", &port, "set", "stored", "1"], 2, "see ubimap param store");
}

#[test]
fn a_port_without_a_robot_is_told_in_one_line() {
    let folder = folder("no-robot");
    let (_silent, silent) = terminal();
    refused(&folder, &["monitor", "/dev/nowhere"], 2, "ubimap ports lists");
    refused(&folder, &["wheels", &silent], 1, "nothing came within 12 s");
    refused(&folder, &["wheels", &silent, "--way", "5"], 2, "from 0.1 to 1 m");
}

/// The rig with a robot 1 that is built in some way, and that robot's program.
struct Rig {
    folder: PathBuf,
    port: String,
    _processes: [Beside; 2],
}

impl Rig {
    fn start(name: &str, built: &[&str]) -> Self {
        let folder = folder(name);
        let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let scenario = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios/corner.toml");
        let number = port.to_string();
        let usual = ["rig", scenario, "--folder", ".", "--port", &number, "--robots", "1"];
        let rig = Beside::start(&folder, &[&usual[..], built].concat());
        let began = Instant::now();
        while !folder.join("robot-1.toml").exists() {
            assert!(began.elapsed() < Duration::from_secs(60), "no rig");
            thread::sleep(Duration::from_millis(100));
        }
        let robot = Beside::start(&folder, &["robot", "robot-1.toml"]);
        Self { folder, port: format!("udp:{port}"), _processes: [rig, robot] }
    }

    /// The findings about the wheels of the robot: each try's, and the whole report.
    fn wheels(&self, more: &[&str]) -> (Vec<Value>, Value) {
        let output = run(&self.folder, &[&["wheels", &self.port, "--json"], more].concat());
        let text = String::from_utf8(output.stdout).unwrap();
        let report: Value = serde_json::from_str(&text).unwrap_or_else(|error| {
            panic!("{error}: {text}{}", String::from_utf8_lossy(&output.stderr))
        });
        println!("{report}");
        let findings = report["tries"].as_array().unwrap().clone();
        let is_good =
            findings.iter().all(|it| it["finding"] == "good") && report["view"] != "floor";
        assert_eq!(output.status.code(), Some(i32::from(!is_good)));
        (findings, report)
    }
}

/// With a lidar, which sees where the robot has gone, no person is needed. This is also the lidar's way from its
/// simulated bytes to the server.
#[test]
#[ignore = "takes two minutes of real time: cargo real-time"]
fn the_cause_of_wrong_wheels_is_found_by_a_robot_with_a_lidar() {
    for (fault, told) in [
        ("", &[("finding", Value::from("good")), ("finding", Value::from("good"))][..]),
        ("left-motor", &[("finding", "motor".into())]),
        ("right-motor", &[("finding", "motor".into())]),
        ("swapped-motors", &[("finding", "good".into()), ("finding", "swapped_motors".into())]),
        ("swapped-encoders", &[("finding", "good".into()), ("finding", "swapped_encoders".into())]),
    ] {
        let built = format!("1:{fault}");
        let built: &[&str] = if fault.is_empty() { &[] } else { &["--fault", &built] };
        let rig = Rig::start(&format!("wheels-{fault}"), &[&["--lidar", "1"], built].concat());
        let (findings, _) = rig.wheels(&[]);
        assert_eq!(findings.len(), told.len(), "{fault}: {findings:?}");
        for (finding, (key, expected)) in findings.iter().zip(told) {
            assert_eq!(&finding[*key], expected, "{fault}: {findings:?}");
        }
        if fault.ends_with("t-motor") {
            assert_eq!(findings[0]["left"], Value::from(fault == "left-motor"));
        }
    }
}

/// A depth camera sees too little for some motions; then the person says what the robot did.
#[test]
#[ignore = "takes a minute of real time: cargo real-time"]
fn a_person_tells_a_motor_from_an_encoder() {
    let rig = Rig::start("wheels-encoder", &["--fault", "1:right-encoder"]);
    // It turns to the left, but counts a turn to the right.
    let (findings, _) = rig.wheels(&["--saw-ahead", "left"]);
    assert_eq!((&findings[0]["finding"], &findings[0]["left"]), (&"encoder".into(), &false.into()));
    let rig = Rig::start("wheels-counts", &["--lidar", "1", "--fault", "1:ticks=1.2"]);
    let (findings, _) = rig.wheels(&["--way", "0.8"]);
    assert_eq!(findings[0]["finding"], "ticks", "{findings:?}");
    let ratio = findings[0]["ratio"].as_f64().unwrap();
    assert!((ratio - 1.2).abs() < findings[0]["error"].as_f64().unwrap(), "{ratio}");
}

#[test]
#[ignore = "takes half a minute of real time: cargo real-time"]
fn a_sensor_that_looks_down_is_told_by_the_floor_that_it_sees() {
    let rig = Rig::start("tilt", &["--fault", "1:tilt=8"]);
    let (_, report) = rig.wheels(&["--height", "0.2"]);
    assert_eq!(report["view"], "floor");
    let degrees = report["looks_down_deg"].as_f64().unwrap();
    assert!((degrees - 8.0).abs() < 0.5, "{degrees}");
    let text = printed(&rig.folder, &["sensor", &rig.port, "--duration", "5", "--json"]);
    let views: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(views.len() >= 3, "{text}");
    let line = views[0]["flat_m"].as_f64().unwrap();
    // 0.2 m above the floor and 0.1 m ahead of the middle.
    assert!((line - 0.1 - 0.2 / 8_f64.to_radians().tan()).abs() < 0.05, "{line}");
    let text = printed(&rig.folder, &["sensor", &rig.port, "--duration", "3"]);
    assert!(text.contains('#') && text.contains("a line straight across"), "{text}");
}
