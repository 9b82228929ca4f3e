//! A robot that talks to its server on standard input and output: it stands in a room with a door that
//! opens and shuts, and maps it.
//!
//! `ubimap conformance --exec target/debug/examples/stdio_robot` checks it.

use std::{
    array,
    io::{self, Read, Write},
    sync::mpsc,
    thread, time,
};

use ubimap_agent::{Bounds, Config, Memory, Robot, memory, sense::SensorModel};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

/// A lidar with 64 beams.
const BOUNDS: Bounds = Bounds { readings: 64, ..Bounds::REFERENCE };
/// Intervals of odometry and scans.
const ODOMETRY: Duration = Duration::from_millis(50);
const SCANS: Duration = Duration::from_millis(200);
/// How long the door stays open, and shut, in microseconds.
const DOOR: u64 = 5_000_000;

fn main() -> io::Result<()> {
    let bytes = listen();
    let started = time::Instant::now();
    let now = || Instant(started.elapsed().as_micros() as u64);
    let sensor = SensorModel::Radial { first: -1.6, step: 0.05 };
    let boot_nonce = std::process::id().wrapping_mul(0x9E37_79B1);
    let config = Config { boot_nonce, ..Config::new(RobotId(7), sensor, BOUNDS) };
    let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
    let mut robot = Robot::new(config, &mut memory).map_err(io::Error::other)?;
    let (mut next_odometry, mut next_scan) = (Instant(0), Instant(0));
    let mut out = io::stdout();
    let mut frame = [0; DEFAULT_FRAME];
    loop {
        let due = robot.poll_timeout().min(next_odometry).min(next_scan);
        let wait = time::Duration::from_micros(due.since(now()).micros());
        match bytes.recv_timeout(wait) {
            Ok(bytes) => robot.receive(&bytes, now()),
            Err(mpsc::RecvTimeoutError::Timeout) => {}
            // The server has gone.
            Err(mpsc::RecvTimeoutError::Disconnected) => return Ok(()),
        }
        let now = now();
        if next_odometry <= now {
            next_odometry = now + ODOMETRY;
            robot.odometry(now, Pose::default(), now);
        }
        if next_scan <= now {
            next_scan = now + SCANS;
            let is_open = now.micros() / DOOR % 2 == 1;
            let readings: [u16; BOUNDS.readings] =
                array::from_fn(|beam| if is_open && beam < 20 { 1_500 } else { 1_100 });
            // The robot counts a refused scan and reports it to the server.
            let _ = robot.scan(now, &readings, now);
        }
        robot.timeout(now);
        while let Some(count) = robot.poll_transmit(now, &mut frame) {
            out.write_all(&frame[..count])?;
            out.flush()?;
        }
    }
}

/// The bytes from standard input, until it ends.
fn listen() -> mpsc::Receiver<Vec<u8>> {
    let (send, bytes) = mpsc::channel();
    thread::spawn(move || {
        let mut buffer = [0; 1_024];
        while let Ok(count @ 1..) = io::stdin().read(&mut buffer) {
            if send.send(buffer[..count].to_vec()).is_err() {
                return;
            }
        }
    });
    bytes
}
