//! The whole system as real processes: `ubimap rig` as the outside world, `ubimap serve` with its cameras,
//! and `ubimap robot` for each robot over UDP. Run it on an idle machine with `cargo live`.
#![cfg(target_os = "linux")]

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    thread,
    time::{Duration, Instant},
};

use serde_json::Value;

/// How long a process may take to end, or to do what is waited for.
const PATIENCE: Duration = Duration::from_secs(60);

/// A process of the system; killed if the test fails.
struct Process(Option<Child>);

impl Process {
    fn signal(&self, name: &str) {
        let id = self.0.as_ref().unwrap().id().to_string();
        assert!(Command::new("kill").args([name, &id]).status().unwrap().success());
    }

    fn kill(mut self) {
        let mut child = self.0.take().unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// Ends it in order. Returns what it has printed.
    fn end(mut self) -> String {
        self.signal("-TERM");
        let output = self.0.take().unwrap().wait_with_output().unwrap();
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

/// A rig with its folder.
struct System {
    folder: PathBuf,
    port: u16,
}

impl System {
    /// A new folder, named after the test.
    fn new(name: &str) -> Self {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).unwrap();
        let free = std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        Self { folder, port: free.port() }
    }

    fn start(&self, log: &str, arguments: &[&str]) -> Process {
        let log = fs::OpenOptions::new().create(true).append(true).open(self.folder.join(log));
        let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
        command.current_dir(&self.folder).env_remove("RUST_LOG").args(arguments);
        command.stdout(Stdio::piped()).stderr(log.unwrap());
        Process(Some(command.spawn().unwrap()))
    }

    fn rig(&self) -> Process {
        let scenario = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios/corner.toml");
        let (scenario, port) = (scenario.to_str().unwrap(), self.port.to_string());
        let arguments =
            ["rig", scenario, "--folder", ".", "--port", &port, "--map", "ubimap-out/map.yaml"];
        let rig = self.start("rig.log", &arguments);
        self.wait_for("the rig's files", || self.folder.join("robot-2.toml").exists());
        rig
    }

    fn serve(&self) -> Process {
        let server =
            self.start("serve.log", &["serve", "deployment.toml", "--open", "--explore", "--json"]);
        self.wait_for("the server", || self.ask(&["status"]).is_some());
        server
    }

    fn robot(&self, number: u16) -> Process {
        let name = format!("robot-{number}");
        self.start(&format!("{name}.log"), &["robot", &format!("{name}.toml")])
    }

    /// The answer of the running server.
    fn ask(&self, arguments: &[&str]) -> Option<String> {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
        let output = command.current_dir(&self.folder).args(arguments).output().unwrap();
        output.status.success().then(|| String::from_utf8(output.stdout).unwrap())
    }

    #[track_caller]
    fn wait_for(&self, what: &str, is_there: impl Fn() -> bool) {
        let began = Instant::now();
        while !is_there() {
            assert!(began.elapsed() < PATIENCE, "timeout while waiting for {what}");
            thread::sleep(Duration::from_millis(200));
        }
    }

    /// The area that the server's map knows, in square metres.
    fn known_m2(&self) -> f64 {
        // The map file is written every minute; the number of tiles is not enough.
        let status = self.ask(&["status"]).unwrap_or_default();
        let line = status.lines().find(|line| line.contains(" m2 known"));
        line.and_then(|line| line.split(' ').next()?.parse().ok()).unwrap_or(0.0)
    }

    /// Calls the robots back into the cameras' view, stops them, ends all processes and compares the
    /// results with the truth.
    fn finish(self, rig: Process, server: Process, robots: Vec<Process>) -> Results {
        self.wait_for("robot 1 to turn back", || self.ask(&["go", "1", "0.9", "1.2"]).is_some());
        self.wait_for("robot 2 to turn back", || self.ask(&["go", "2", "1.2", "2.6"]).is_some());
        thread::sleep(Duration::from_secs(25));
        self.ask(&["stop"]).unwrap();
        // They brake, and report where they stand.
        thread::sleep(Duration::from_secs(6));
        let report: Value = serde_json::from_str(&server.end()).unwrap();
        robots.into_iter().for_each(|robot| drop(robot.end()));
        let truth: Value = serde_json::from_str(&rig.end()).unwrap();
        let mut errors = Vec::new();
        for robot in truth["robots"].as_array().unwrap() {
            let (number, pose) = (&robot[0], &robot[1]);
            let ports = report["ports"].as_array().unwrap();
            let found =
                ports.iter().find(|port| port["robot"] == *number && port["session"] == true);
            let found =
                &found.unwrap_or_else(|| panic!("robot {number} is away: {report}"))["state"];
            let at = |pose: &Value, axis: usize| pose[axis].as_f64().unwrap();
            let off = |axis: usize| at(&found["pose"], axis) - at(pose, axis);
            let turn = (off(2) + 540.0).rem_euclid(360.0) - 180.0;
            errors.push((off(0).hypot(off(1)), turn.abs()));
        }
        let results = Results {
            f1: truth["truth"]["f1_occupied"].as_f64().unwrap(),
            collisions: truth["collisions"].as_u64().unwrap(),
            errors,
        };
        println!("{results:?}\n{report}\n{truth}");
        results
    }
}

#[derive(Debug)]
struct Results {
    f1: f64,
    collisions: u64,
    /// For each robot, in metres and degrees.
    errors: Vec<(f64, f64)>,
}

impl Results {
    #[track_caller]
    fn check(&self) {
        assert!(self.f1 >= 0.97, "{self:?}");
        assert_eq!(self.collisions, 0, "{self:?}");
        for (off_m, off_deg) in &self.errors {
            assert!(*off_m <= 0.02 && *off_deg <= 1.0, "{self:?}");
        }
    }
}

#[test]
#[ignore = "takes two minutes of an idle machine"]
fn robots_explore_what_the_cameras_do_not_see() {
    let system = System::new("live");
    let (rig, server) = (system.rig(), system.serve());
    let robots = vec![system.robot(1), system.robot(2)];
    thread::sleep(Duration::from_secs(100));
    println!("{:.1} m2 known", system.known_m2());
    system.finish(rig, server, robots).check();
}

/// The server is killed and comes back, then a robot, then the rig's cameras find the server again.
#[test]
#[ignore = "takes two minutes of an idle machine"]
fn a_killed_server_and_a_killed_robot_come_back() {
    let system = System::new("live-killed");
    let (rig, server) = (system.rig(), system.serve());
    let mut robots = vec![system.robot(1), system.robot(2)];
    thread::sleep(Duration::from_secs(30));
    server.kill();
    thread::sleep(Duration::from_secs(5));
    let server = system.serve();
    thread::sleep(Duration::from_secs(20));
    robots.remove(0).kill();
    thread::sleep(Duration::from_secs(5));
    robots.insert(0, system.robot(1));
    thread::sleep(Duration::from_secs(60));
    system.finish(rig, server, robots).check();
}
