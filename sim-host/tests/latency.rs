//! The delay of a live server from the arrival of a camera's frame to the messages for the robots: recorded frames of
//! two cameras of 640 x 480 pixels at 15 Hz with their pictures, and ten robots over UDP. `cargo latency` prints it.
#![cfg(target_os = "linux")]

use std::{
    fmt::Write,
    fs,
    net::{SocketAddr, UdpSocket},
    path::{Path, PathBuf},
    process::{Command, Stdio},
    thread,
    time::{Duration as Span, Instant as Clock},
};

use serde_json::Value;
use ubimap_agent::{Bounds, Config, Memory, Robot, sense::SensorModel};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    time::{Duration, Instant},
    units::{Pose, RobotId},
};
use ubimap_sim_host::run::heap::{BOUNDS, Heap};

const ROBOTS: u16 = 10;
const RECORDED_S: u32 = 30;
const BEAMS: usize = 160;
const SCAN_INTERVAL: Duration = Duration::from_millis(100);

/// A room with two cameras; robots drive through their views, and two people walk.
fn scenario() -> String {
    let mut text = format!(
        "duration_s = {RECORDED_S}\nslice_height_m = 0.2\n\
         [room]\nheight_m = 3.0\noutline_m = [[0.0, 0.0], [6.0, 0.0], [6.0, 5.0], [0.0, 5.0]]\n\
         [[furniture]]\nfootprint.box = {{ centre_m = [5.4, 0.6], size_m = [0.6, 0.6] }}\ntop_m = 0.8\n\
         [[cameras]]\nposition_m = [0.2, 0.2, 2.9]\nlook_at_m = [3.0, 2.5, 0.0]\n\
         [[cameras]]\nposition_m = [5.8, 4.8, 2.9]\nlook_at_m = [3.0, 2.5, 0.0]\n\
         [[people]]\nwaypoints_m = [[1.0, 2.5], [5.0, 2.7]]\n\
         [[people]]\nwaypoints_m = [[3.0, 4.2], [3.2, 0.8]]\n"
    );
    for robot in 0..ROBOTS {
        let (x, y) = (1.2 + 0.9 * f64::from(robot % 5), 1.2 + 2.2 * f64::from(robot / 5));
        writeln!(
            text,
            "[[robots]]\nid = {}\nmarker_size_m = 0.16\nstart = {{ x_m = {x}, y_m = {y} }}\n\
             route = {{ waypoints_m = [[{x}, {}]] }}",
            robot + 1,
            y + 0.6
        )
        .unwrap();
    }
    text
}

fn ubimap(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ubimap"));
    command.current_dir(folder).env_remove("RUST_LOG").args(arguments).stdout(Stdio::piped());
    command
}

/// Ten robots that scan, each with a socket, until the time is up. Returns the fixes that each has accepted.
fn drive(server: SocketAddr, lasts: Span) -> Vec<u32> {
    let sensor = SensorModel::Radial { first: -0.76, step: 1.52 / 159.0 };
    let bounds = Bounds { readings: BEAMS, ..BOUNDS };
    let mut memories: Vec<Memory<Heap>> = (0..ROBOTS).map(|_| Memory::new(&bounds)).collect();
    let began = Clock::now();
    let now = || Instant(began.elapsed().as_micros() as u64);
    let mut robots: Vec<_> = (1..)
        .zip(&mut memories)
        .map(|(number, memory)| {
            let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
            socket.connect(server).unwrap();
            socket.set_nonblocking(true).unwrap();
            let first = Instant(0) + Duration::from_millis(10 * u64::from(number));
            (
                Robot::new(Config::new(RobotId(number), sensor, bounds), memory).unwrap(),
                socket,
                first,
            )
        })
        .collect();
    let mut buffer = vec![0; DEFAULT_FRAME];
    while began.elapsed() < lasts {
        for (robot, socket, next) in &mut robots {
            while let Ok(count) = socket.recv(&mut buffer) {
                robot.receive(&buffer[..count], now());
            }
            let moment = now();
            if *next <= moment {
                *next = *next + SCAN_INTERVAL;
                let swings = 1_200 + (moment.micros() / 20_000 % 200) as u16;
                robot.odometry(moment, Pose::from_metres(0.0, 0.0, 0.0), moment);
                // A robot that lags drops the scan.
                let _ = robot.scan(moment, &[swings; BEAMS], moment);
            }
            robot.timeout(moment);
            while let Some(len) = robot.poll_transmit(moment, &mut buffer) {
                // The server may be gone.
                let _ = socket.send(&buffer[..len]);
            }
        }
        thread::sleep(Span::from_millis(2));
    }
    robots.iter().map(|(robot, ..)| robot.statistics().fixes).collect()
}

#[test]
#[ignore = "needs an idle machine for a minute, and half a gigabyte of disk"]
fn the_messages_leave_within_a_tenth_of_a_second() {
    let folder: PathBuf = Path::new(env!("CARGO_TARGET_TMPDIR")).join("latency");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("room.toml"), scenario()).unwrap();
    let record = ["simulate", "room.toml", "--scripted", "--record", "rec", "--json"];
    assert!(ubimap(&folder, &record).output().unwrap().stdout.starts_with(b"{"));

    let free = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut text = format!("ports = ['udp:{}']\nout = 'out'\n", free.port());
    for camera in ["camera-00", "camera-01"] {
        writeln!(text, "[[cameras]]\nname = '{camera}'\nsource = 'folder:rec/{camera}'").unwrap();
    }
    text += &fs::read_to_string(folder.join("rec/robots.toml")).unwrap();
    fs::write(folder.join("deployment.toml"), text).unwrap();
    let lasts = (RECORDED_S + 1).to_string();
    let serve = ["serve", "deployment.toml", "--open", "--json", "--duration", &lasts];
    let server = ubimap(&folder, &serve).spawn().unwrap();
    let fixes = drive(free, Span::from_secs(RECORDED_S.into()));
    let output = server.wait_with_output().unwrap();
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let of = |key: &str| {
        report["cameras"]
            .as_array()
            .unwrap()
            .iter()
            .map(|it| it[key].as_u64().unwrap())
            .sum::<u64>()
    };
    let load = fs::read_to_string("/proc/loadavg").unwrap();
    println!(
        "{} frames, {} skipped, {} mapped; delays {}; fixes {fixes:?}; load {load}",
        of("frames"),
        of("skipped"),
        of("looks"),
        report["delays"]
    );
    assert!(fixes.iter().all(|fixes| *fixes > 5 * RECORDED_S), "{fixes:?}");
    assert!(report["delays"]["p99_ms"].as_u64().unwrap() < 100, "{}", report["delays"]);
    fs::remove_dir_all(folder).unwrap();
}
