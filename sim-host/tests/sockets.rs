//! `ubimap serve` on sockets: robots over UDP and TCP at one server.
#![cfg(unix)]

use std::{
    net::{SocketAddr, UdpSocket},
    process::{Child, Command, Stdio},
    time,
};

use ubimap_agent::{Bounds, Config, Memory, Robot, Seal, sense::SensorModel};
use ubimap_protocol::{time::Instant, units::RobotId};
use ubimap_sim_host::{
    channel::{tcp, udp::UdpLink, wire::Wire},
    run::{
        heap::{BOUNDS, Heap},
        keys,
    },
};

const PATIENCE: time::Duration = time::Duration::from_secs(60);

/// A free port of this machine.
fn free() -> SocketAddr {
    UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap()
}

fn serve(arguments: &[&str]) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
    command.arg("serve").args(arguments).stdout(Stdio::piped()).stderr(Stdio::piped());
    command.spawn().unwrap()
}

fn memory(robot: u16) -> (Config, Memory<Heap>) {
    let model = SensorModel::Radial { first: -3.0, step: 0.1 };
    let bounds = Bounds { readings: 60, fused_tiles: 16, max_range: 1_400, ..BOUNDS };
    (Config::new(RobotId(robot), model, bounds), Memory::new(&bounds))
}

/// A robot that maps nothing, at the end of a wire.
struct Bench<'b> {
    robot: Robot<'b>,
    wire: Wire,
    started: time::Instant,
}

impl Bench<'_> {
    fn turn(&mut self) {
        let mut buffer = [0; 1_024];
        let wait = time::Duration::from_millis(1);
        let count = self.wire.reader.read_within(&mut buffer, wait).unwrap();
        let now = Instant(self.started.elapsed().as_micros() as u64);
        self.robot.receive(&buffer[..count], now);
        self.robot.timeout(now);
        while let Some(len) = self.robot.poll_transmit(now, &mut buffer) {
            // The server may not listen yet.
            let _ = self.wire.writer.write(&buffer[..len]);
        }
    }

    #[track_caller]
    fn turn_until(&mut self, what: &str, done: impl Fn(&Robot<'_>) -> bool) {
        let began = time::Instant::now();
        while !done(&self.robot) {
            assert!(began.elapsed() < PATIENCE, "timeout while waiting until {what}");
            self.turn();
        }
    }
}

#[test]
fn robots_on_udp_and_tcp_share_a_server_and_one_that_hung_up_is_found_again() {
    let (udp, tcp) = (free(), free());
    let ports = [format!("udp:{udp}"), format!("tcp:{}", tcp.port())];
    let server = serve(&[&ports[0], &ports[1], "--open", "--pose", "1,2,3", "--json"]);
    let connected = || {
        let began = time::Instant::now();
        loop {
            match tcp::connect(tcp, PATIENCE) {
                Ok(wire) => return wire,
                Err(error) => assert!(began.elapsed() < PATIENCE, "{error}"),
            }
        }
    };
    let mut memories = [1, 2, 3].map(memory);
    let [(one, a), (two, b), (three, c)] = &mut memories;
    let started = time::Instant::now();
    let bench = |robot, wire| Bench { robot, wire, started };
    let udp_wire = || UdpLink::open(udp, None).unwrap().into_wire();
    let mut all = [
        bench(Robot::new(*one, a).unwrap(), udp_wire()),
        bench(Robot::new(*two, b).unwrap(), udp_wire()),
        bench(Robot::new(*three, c).unwrap(), connected()),
    ];
    for bench in &mut all {
        bench.turn_until("the robot has a pose", |robot| robot.pose().is_some());
    }
    // A TCP connection that is gone frees the robot's number at once.
    let [first, _, third] = &mut all;
    third.wire = connected();
    let met = third.robot.statistics().sessions;
    third.turn_until("the robot has another session", |robot| {
        robot.is_connected() && robot.statistics().sessions > met
    });
    first.turn_until("the first robot goes on", |robot| robot.is_connected());

    let ended = Command::new("kill").args(["-TERM", &server.id().to_string()]).status().unwrap();
    assert!(ended.success());
    let output = server.wait_with_output().unwrap();
    let [report, words] = [output.stdout, output.stderr].map(|it| String::from_utf8(it).unwrap());
    assert_eq!(output.status.code(), Some(0), "{words}");
    assert!(words.contains("is open: whoever reaches it"), "{words}");
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    let ports = report["ports"].as_array().unwrap();
    let mut robots: Vec<_> = ports.iter().map(|port| port["robot"].as_u64().unwrap()).collect();
    robots.sort_unstable();
    assert_eq!(robots, [1, 2, 3], "{report}");
    assert!(ports.iter().all(|port| port["link"]["received"].as_u64() >= Some(3)), "{report}");
}

#[test]
fn with_keys_only_robots_that_have_them_are_served() {
    let folder = std::env::temp_dir().join(format!("ubimap-keys-{}", std::process::id()));
    let keys = folder.to_str().unwrap();
    let made = Command::new(env!("CARGO_BIN_EXE_ubimap"))
        .args(["keys", "make", "7", "--dir", keys])
        .output()
        .unwrap();
    assert!(made.status.success(), "{made:?}");
    let (_, key) = keys::load(&folder).unwrap()[0];
    let udp = free();
    let server = serve(&[&format!("udp:{udp}"), "--keys", keys, "--pose", "1,2,3", "--json"]);
    let started = time::Instant::now();
    let mut memories = [7, 8].map(memory);
    let [(sealed, a), (open, b)] = &mut memories;
    let config = Config { seal: Some(Seal { key, boot: 1 }), ..*sealed };
    let bench = |robot| {
        let wire = UdpLink::open(udp, None).unwrap().into_wire();
        Bench { robot, wire, started }
    };
    let mut stranger = bench(Robot::new(*open, b).unwrap());
    let mut robot = bench(Robot::new(config, a).unwrap());
    robot.turn_until("the robot has a pose", |robot| robot.pose().is_some());
    // It knocks several times and gets no answer.
    let until = time::Instant::now() + time::Duration::from_secs(1);
    while time::Instant::now() < until {
        stranger.turn();
        robot.turn();
    }
    assert!(!stranger.robot.is_connected() && stranger.robot.link_counters().sent > 2);
    let ended = Command::new("kill").args(["-TERM", &server.id().to_string()]).status().unwrap();
    assert!(ended.success());
    let output = server.wait_with_output().unwrap();
    let [report, words] = [output.stdout, output.stderr].map(|it| String::from_utf8(it).unwrap());
    assert!(!words.contains("is open"), "{words}");
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    let served = report["ports"].as_array().unwrap().iter().filter(|it| it["robot"] == 7);
    assert_eq!(served.count(), 1, "{report}");
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn a_socket_is_refused_unless_it_is_opened_on_purpose() {
    let output = serve(&["udp:0"]).wait_with_output().unwrap();
    let words = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), words.lines().count()), (Some(2), 1), "{words}");
    assert!(words.contains("udp:127.0.0.1:0: ") && words.contains("--open"), "{words}");
}
