//! A deployment as its user meets it: real processes of `ubimap serve` and `ubimap robot`.
#![cfg(target_os = "linux")]

use std::{
    fs,
    io::{BufRead, BufReader},
    os::unix::net::UnixStream,
    path::{Path, PathBuf},
    process::{Child, Command, Output, Stdio},
    sync::mpsc,
    thread,
    time::{Duration, Instant},
};

use serde_json::Value;
use ubimap_sim_host::{
    camera::{
        DepthImage,
        stream::{self, StreamedFrame},
    },
    grid,
};

/// How long a process may take to do what is waited for.
const PATIENCE: Duration = Duration::from_secs(60);

/// A process, killed if the test fails, and the lines that it logs.
struct Process {
    child: Option<Child>,
    log: mpsc::Receiver<String>,
}

impl Process {
    fn id(&self) -> String {
        self.child.as_ref().unwrap().id().to_string()
    }

    fn kill(&mut self) {
        let child = self.child.as_mut().unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// Ends it in order. Returns what it has printed.
    fn end(mut self) -> String {
        assert!(Command::new("kill").args(["-TERM", &self.id()]).status().unwrap().success());
        let output = self.child.take().unwrap().wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(0));
        String::from_utf8(output.stdout).unwrap()
    }

    /// Waits for a line of its log that contains all parts.
    #[track_caller]
    fn await_line(&self, parts: &[&str]) -> String {
        let mut lines = Vec::new();
        loop {
            let Ok(line) = self.log.recv_timeout(PATIENCE) else {
                panic!("no line with {parts:?} in:\n{}", lines.join("\n"))
            };
            if parts.iter().all(|part| line.contains(part)) {
                return line;
            }
            lines.push(line);
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if let Some(child) = &mut self.child {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// A folder with a deployment.
struct Lab {
    folder: PathBuf,
    port: u16,
}

impl Lab {
    /// A new folder, named after the test, with a deployment of two robots and one port.
    fn new(name: &str, more: &str) -> Self {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("deployment-{name}"));
        let _ = fs::remove_dir_all(&folder);
        fs::create_dir_all(&folder).unwrap();
        let free = std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let lab = Self { folder, port: free.port() };
        let robots = [1, 2]
            .map(|id| format!("[[robots]]\nid = {id}\nmarker_size_m = 0.1\nheight_m = 0.3\n"));
        let text = format!("ports = [\"udp:{}\"]\n{more}\n\n{}", lab.port, robots.concat());
        lab.file("deployment.toml", &text);
        lab
    }

    fn file(&self, name: &str, text: &str) {
        fs::write(self.folder.join(name), text).unwrap();
    }

    /// A robot's configuration; its devices are unplugged.
    fn robot_file(&self, id: u16, more: &str) -> String {
        let name = format!("robot-{id}.toml");
        let text = format!(
            "id = {id}\nserver = \"udp:{}\"\nsensor = \"none\"\nwheels = \"none\"\n{more}\n",
            self.port
        );
        self.file(&name, &text);
        name
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
        command.current_dir(&self.folder).env_remove("RUST_LOG").args(arguments);
        command
    }

    fn run(&self, arguments: &[&str]) -> Output {
        self.command(arguments).output().unwrap()
    }

    /// Runs a command that must succeed. Returns what it has printed.
    #[track_caller]
    fn print(&self, arguments: &[&str]) -> String {
        let output = self.run(arguments);
        assert!(output.status.success(), "{output:?}");
        String::from_utf8(output.stdout).unwrap()
    }

    fn start(&self, arguments: &[&str]) -> Process {
        let mut command = self.command(arguments);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let (sender, log) = mpsc::channel();
        let lines = BufReader::new(child.stderr.take().unwrap()).lines();
        thread::spawn(move || lines.map_while(Result::ok).all(|line| sender.send(line).is_ok()));
        Process { child: Some(child), log }
    }

    /// Waits until `ubimap status` prints a line that contains all parts; returns it.
    #[track_caller]
    fn await_status(&self, parts: &[&str]) -> String {
        let began = Instant::now();
        loop {
            let output = self.run(&["status"]);
            let status = String::from_utf8(output.stdout).unwrap();
            let is_wanted = |line: &&str| parts.iter().all(|part| line.contains(part));
            if let Some(line) = status.lines().find(is_wanted) {
                return line.to_owned();
            }
            assert!(began.elapsed() < PATIENCE, "{parts:?} is not in:\n{status}");
            thread::sleep(Duration::from_millis(50));
        }
    }
}

/// The number of its boot keeps a robot's seals fresh: it counts up with every start, and a server that has seen a
/// higher one lets nobody in.
#[test]
fn a_sealed_robot_is_served_after_every_boot_and_keys_change_while_all_run() {
    let lab = Lab::new("sealed", "keys = \"keys\"");
    lab.print(&["keys", "make", "1"]);
    let server = lab.start(&["serve", "deployment.toml", "--json", "-v"]);
    lab.await_status(&["robot 1: ", "is not connected"]);
    // A fixed local port, so that a robot that was killed is welcomed at once.
    let local = std::net::UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let config = lab.robot_file(1, &format!("keys = \"keys\"\nlocal = \"{local}\""));
    let boots = || fs::read_to_string(lab.folder.join("robot-1.boot")).unwrap();

    for boot in ["1\n", "2\n"] {
        let mut robot = lab.start(&["robot", &config]);
        server.await_line(&["robot 1 has a session"]);
        lab.await_status(&["robot 1: ", "has no known position; heard ", " ago at udp:127.0.0.1:"]);
        assert_eq!(boots(), boot);
        robot.kill();
    }

    // A robot whose counter was lost repeats seals of its first life: it is shut out, and the server says why.
    fs::remove_file(lab.folder.join("robot-1.boot")).unwrap();
    let mut robot = lab.start(&["robot", &config]);
    server.await_line(&["robot 1", "boot"]);
    robot.kill();

    // Without a key nobody gets in; a key that is made while the server runs is enough.
    let config = lab.robot_file(2, "keys = \"keys\"");
    let refused = lab.run(&["robot", &config]);
    let words = String::from_utf8(refused.stderr).unwrap();
    assert!(words.contains("there is no 2.key") && words.lines().count() == 1, "{words}");
    lab.print(&["keys", "make", "2"]);
    server.await_line(&["robot 2 has a new key"]);
    let robot = lab.start(&["robot", &config]);
    lab.await_status(&["robot 2: ", "; heard "]);
    lab.await_status(&["robot 2: ", "has no known position"]);
    lab.print(&["keys", "retire", "2"]);
    server.await_line(&["robot 2 has no key any more"]);
    lab.await_status(&["robot 2: ", "is not connected"]);
    robot.end();

    let report: Value = serde_json::from_str(&server.end()).unwrap();
    let robots = report["robots"].as_array().unwrap();
    assert_eq!((robots.len(), &robots[1]["session"]), (2, &Value::Bool(false)), "{report}");
}

/// What a camera captures from the start on is recorded under its name, for `watch` and `calibrate`, which need no pose.
#[test]
fn the_frames_of_a_camera_are_recorded() {
    let depth = "depth = { width = 40, height = 30, fx = 30.0, fy = 30.0, cx = 19.5, cy = 14.5 }";
    let camera = format!("[[cameras]]\nname = \"north\"\nsource = \"stream:north.sock\"\n{depth}");
    let lab = Lab::new("recorded", &camera);
    let recording = lab.start(&["record", "deployment.toml", "rec"]);
    let began = Instant::now();
    let mut sender = loop {
        match UnixStream::connect(lab.folder.join("north.sock")) {
            Ok(sender) => break sender,
            Err(error) => assert!(began.elapsed() < PATIENCE, "{error}"),
        }
    };
    let images = lab.folder.join("rec/north/depth");
    let count = || fs::read_dir(&images).map_or(0, Iterator::count);
    // The first was captured ten minutes before.
    for number in 0..=3 {
        let depth = Some(DepthImage::from_pixel(40, 30, image::Luma([1_000 + number as u16])));
        let sent = 600_000_000 + number * 100_000;
        let captured = if number == 0 { 0 } else { sent };
        let frame = StreamedFrame { captured, sent, depth, picture: None };
        stream::write(&mut sender, &frame).unwrap();
        if number == 0 {
            // So that no later frame replaces it before it is looked at.
            thread::sleep(Duration::from_millis(300));
        }
        while count() < number as usize {
            assert!(began.elapsed() < PATIENCE, "frame {number} is not recorded");
            thread::sleep(Duration::from_millis(10));
        }
    }
    let told = recording.end();
    assert!(!lab.folder.join("north.sock").exists(), "the camera's socket is left behind");
    assert!(told.starts_with("camera north: 3 frames\nrecorded in rec; "), "{told}");
    let watched = lab.print(&["watch", "rec", "--json", "--out", "watched"]);
    let report: Value = serde_json::from_str(&watched).unwrap();
    assert_eq!(
        (&report["cameras"][0]["name"], &report["cameras"][0]["frames"]),
        (&"north".into(), &3.into())
    );
    // A second recording does not mix with it.
    let again = lab.run(&["record", "deployment.toml", "rec"]);
    assert!(String::from_utf8(again.stderr).unwrap().contains("not empty"));
}

/// `status`, `go` and the floor, with a robot whose pose nobody knows.
#[test]
fn commands_are_answered_in_words() {
    let lab = Lab::new("commands", "floor = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]");
    let refused = |arguments: &[&str]| {
        let output = lab.run(arguments);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        let words = String::from_utf8(output.stderr).unwrap();
        words.lines().last().unwrap().to_owned()
    };
    assert!(refused(&["status"]).contains("no server answers"));
    let server = lab.start(&["serve", "deployment.toml", "--open", "--json"]);
    lab.await_status(&["robot 1: never seen by a camera; is not connected; never heard"]);
    let config = lab.robot_file(1, "");
    let robot = lab.start(&["robot", &config]);
    lab.await_status(&["robot 1: never seen by a camera; has no known position; heard "]);
    assert!(refused(&["go", "1", "1", "1"]).contains("the position of robot 1 is unknown"));
    let nobody = "there is no robot 9; the robots are 1 (connected)";
    assert!(refused(&["go", "9", "1", "1"]).contains(nobody));
    assert!(refused(&["stop", "9"]).contains(nobody));
    assert_eq!(lab.print(&["stop"]), "stopped: 1\n");
    lab.await_status(&["robot 1: ", "was told to stop"]);
    assert_eq!(lab.print(&["explore", "1"]), "exploring: 1\n");
    // A second server for the same deployment is refused.
    let second = refused(&["serve", "deployment.toml", "--open"]);
    assert!(second.contains("udp:127.0.0.1") && second.contains("stop that one"), "{second}");
    drop(robot.end());
    let report: Value = serde_json::from_str(&server.end()).unwrap();
    assert_eq!(report["robots"][0]["robot"], 1);
    assert!(!lab.folder.join("deployment.sock").exists(), "the socket is left behind");
    assert!(refused(&["status"]).contains("no server answers"));
}

/// The results in a folder, each of which must be whole. Returns the report.
fn whole_results(out: &Path) -> Value {
    let read = |name: &str| fs::read(out.join(name)).unwrap();
    let report: Value = serde_json::from_slice(&read("report.json")).unwrap();
    assert_eq!(report["schema"], "ubimap-serve");
    grid::read_map(&out.join("map.yaml")).unwrap();
    for picture in ["map.png", "coverage.png", "plan.png"] {
        // The last chunk of a PNG.
        assert!(read(picture).ends_with(b"IEND\xaeB\x60\x82"), "{picture}");
    }
    report
}

/// Whenever somebody reads them and however the server ends, results are whole: it is killed at moments that have
/// nothing to do with its writing, which goes on all the time.
#[test]
fn results_are_whole_when_the_server_is_killed_while_it_writes() {
    let lab = Lab::new("killed", "every_s = 0.1\nplan = \"plan.yaml\"");
    lab.file(
        "plan.yaml",
        "image: plan.pgm\nresolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\n\
         free_thresh: 0.196\n",
    );
    fs::write(lab.folder.join("plan.pgm"), b"P5 2 1 255\n\xfe\x00").unwrap();
    let out = lab.folder.join("ubimap-out");
    let mut reports = std::collections::BTreeSet::new();
    for round in 0..12_u64 {
        let mut server = lab.start(&["serve", "deployment.toml", "--open"]);
        server.await_line(&["port 0 is"]);
        // From 0.1 s to 0.4 s later, in steps that don't repeat.
        let end = Instant::now() + Duration::from_millis(100 + round * 7_919 % 300);
        while Instant::now() < end {
            match out.exists() {
                true => drop(whole_results(&out)),
                false => thread::sleep(Duration::from_millis(1)),
            }
        }
        server.kill();
        if out.exists() {
            reports.insert(whole_results(&out)["elapsed_s"].to_string());
        }
        assert_eq!(out.exists(), !reports.is_empty(), "results have gone");
    }
    assert!(reports.len() > 6, "{reports:?}");
    // The next server that ends in order leaves nothing of the killed ones behind.
    let server = lab.start(&["serve", "deployment.toml", "--open"]);
    server.await_line(&["port 0 is"]);
    server.end();
    let left: Vec<_> = fs::read_dir(&lab.folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.contains("partial"))
        .collect();
    assert!(left.is_empty(), "{left:?}");
}
