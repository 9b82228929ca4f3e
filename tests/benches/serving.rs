//! Latency of a server with many robots, from a camera frame to the fixes.
//!
//! Two threads run in real time: the server with its cameras' observations, and all robots. The
//! robots are real agents that scan ten times per second. Each drives in a circle in its own room;
//! a camera covers half of the room and sees the robot ten times per second. `UBIMAP_ROBOTS` sets
//! the number of robots (default: 200).

use std::{
    sync::mpsc::{self, Receiver, Sender},
    thread,
    time::{Duration as Span, Instant as Clock},
};

use ubimap_agent::{Bounds, Config, Memory, Robot, sense::SensorModel};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, MAX_FRAME},
    link::Terms,
    tile::Cell,
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    run::heap::{BOUNDS, Heap},
    server::Server,
};

const RESOLUTION: Millimetres = Millimetres(50);
const CAMERAS: usize = 8;
/// Interval between frames of a camera, and between scans of a robot.
const INTERVAL: Duration = Duration::from_millis(100);
/// Number of frames per report of a camera's coverage.
const CELLS_EVERY: u64 = 5;
/// Half the side of a robot's room, and the distance between rooms.
const HALF_ROOM_M: f64 = 2.0;
const PITCH_M: f64 = 5.0;
const ROOMS_IN_A_ROW: usize = 15;
/// The radius of a robot's circle, and its speed.
const CIRCLE_M: f64 = 0.8;
const SPEED_M_S: f64 = 0.4;
const BEAMS: usize = 160;
const FIRST_RAD: f64 = -0.76;
const STEP_RAD: f64 = 1.52 / 159.0;
/// Time for opening sessions and synchronising clocks, and the time at which the run ends.
const SETTLES: Span = Span::from_secs(6);
const LASTS: Span = Span::from_secs(16);

/// The number of a port, and bytes received from it or to be sent to it.
type Bytes = (usize, Vec<u8>);

fn main() {
    let robots = std::env::var("UBIMAP_ROBOTS").ok().and_then(|it| it.parse().ok()).unwrap_or(200);
    let began = Clock::now();
    let (to_server, from_robots) = mpsc::channel();
    let (to_robots, from_server) = mpsc::channel();
    let fleet = thread::spawn(move || drive(robots, began, &from_server, &to_server));
    let mut late = serve(robots, began, &from_robots, &to_robots);
    drop(to_robots);
    let Ok(fixes) = fleet.join() else { panic!("the robots' thread ended") };
    late.sort_unstable();
    let share = |part: f64| late[((late.len() - 1) as f64 * part) as usize].as_secs_f64() * 1e3;
    let expected = LASTS.as_secs_f64() / INTERVAL.micros() as f64 * 1e6;
    println!(
        "{robots} robots, {CAMERAS} cameras, {BEAMS} readings a scan, all at 10 Hz: from a frame to \
         its messages {:.1} ms (median), {:.1} ms (99th percentile), {:.1} ms (most); {:.0} % of \
         the fixes taken by the robots",
        share(0.5),
        share(0.99),
        share(1.0),
        fixes as f64 / robots as f64 / expected * 100.0
    );
}

fn now(began: Clock) -> Instant {
    Instant(began.elapsed().as_micros() as u64)
}

/// The pose of a robot at a time.
fn pose(robot: usize, at: Instant) -> Pose {
    let angle = at.0 as f64 / 1e6 * SPEED_M_S / CIRCLE_M + robot as f64;
    let [x, y] = middle(robot);
    let (dx, dy) = (CIRCLE_M * angle.cos(), CIRCLE_M * angle.sin());
    Pose::from_metres(x + dx, y + dy, angle + core::f64::consts::FRAC_PI_2)
}

fn middle(robot: usize) -> [f64; 2] {
    [robot % ROOMS_IN_A_ROW, robot / ROOMS_IN_A_ROW].map(|it| it as f64 * PITCH_M)
}

/// A scan of the square room.
fn scan(robot: usize, at: Instant) -> Vec<u16> {
    let (pose, middle) = (pose(robot, at), middle(robot));
    let here = [pose.x.metres() - middle[0], pose.y.metres() - middle[1]];
    let reading = |beam: usize| {
        let angle = pose.heading.radians() + FIRST_RAD + beam as f64 * STEP_RAD;
        let range = [angle.cos(), angle.sin()]
            .into_iter()
            .zip(here)
            .map(|(along, at)| (HALF_ROOM_M - at * along.signum()) / along.abs().max(1e-9))
            .fold(f64::INFINITY, f64::min);
        (range * 1000.0) as u16
    };
    (0..BEAMS).map(reading).collect()
}

/// The server's thread: returns the time from frame to message for each fix.
fn serve(robots: usize, began: Clock, from: &Receiver<Bytes>, to: &Sender<Bytes>) -> Vec<Span> {
    let terms = Terms {
        resolution: RESOLUTION,
        frame: DEFAULT_FRAME as u16,
        server_epoch: 1,
        stores: false,
    };
    let mut server = Server::new(terms, robots);
    let mut frame = vec![0; MAX_FRAME];
    let mut late = Vec::new();
    let mut due = vec![None; robots];
    let mut frames = 0_u64;
    while began.elapsed() < LASTS {
        let captured = Instant(frames * INTERVAL.micros() / CAMERAS as u64);
        let moment = now(began);
        let back = server.poll_timeout(0, moment).map_or(captured, |back| back.min(captured));
        let wait = Span::from_micros(back.since(moment).micros());
        let first = from.recv_timeout(wait.min(Span::from_millis(5)));
        for (port, bytes) in first.into_iter().chain(from.try_iter()) {
            server.receive(port, &bytes, now(began)).unwrap();
        }
        if now(began) >= captured {
            let camera = frames as usize % CAMERAS;
            let with_cells = (frames / CAMERAS as u64).is_multiple_of(CELLS_EVERY);
            let seen = (camera..robots).step_by(CAMERAS);
            server.observe(&Observation {
                camera,
                captured,
                robots: seen
                    .clone()
                    .map(|it| Sighting::usual(RobotId(it as u16), pose(it, captured)))
                    .collect(),
                cells: seen.clone().filter(|_| with_cells).flat_map(covered).collect(),
                ..Observation::default()
            });
            seen.for_each(|robot| due[robot] = Some(captured));
            frames += 1;
        }
        server.timeout(now(began));
        for (port, due) in due.iter_mut().enumerate() {
            while let Some(len) = server.poll_transmit(port, now(began), &mut frame) {
                if let Some(captured) = due.take().filter(|_| began.elapsed() > SETTLES) {
                    late.push(began.elapsed() - Span::from_micros(captured.0));
                }
                let _ = to.send((port, frame[..len].to_vec()));
            }
        }
    }
    late
}

/// The western half of a robot's room.
fn covered(robot: usize) -> impl Iterator<Item = ((i32, i32), Cell)> {
    let [x, y] = middle(robot).map(|it| (it / RESOLUTION.metres()) as i32);
    (x - 20..x).flat_map(move |x| (y - 20..y + 20).map(move |y| ((x, y), Cell::Free)))
}

/// The robots' thread: returns the number of fixes accepted.
fn drive(robots: usize, began: Clock, from: &Receiver<Bytes>, to: &Sender<Bytes>) -> u64 {
    let sensor = SensorModel::Radial { first: FIRST_RAD as f32, step: STEP_RAD as f32 };
    let bounds = Bounds { readings: BEAMS, ..BOUNDS };
    let mut memory: Vec<Memory<Heap>> = (0..robots).map(|_| Memory::new(&bounds)).collect();
    let mut members: Vec<(Robot<'_>, Instant)> = (0..)
        .zip(&mut memory)
        .map(|(number, memory)| {
            let first = Instant(u64::from(number) * INTERVAL.micros() / robots as u64);
            (Robot::new(Config::new(RobotId(number), sensor, bounds), memory).unwrap(), first)
        })
        .collect();
    let mut frame = vec![0; DEFAULT_FRAME];
    loop {
        match from.recv_timeout(Span::from_millis(2)) {
            Ok((port, bytes)) => members[port].0.receive(&bytes, now(began)),
            Err(mpsc::RecvTimeoutError::Timeout) => {}
            Err(mpsc::RecvTimeoutError::Disconnected) => break,
        }
        for (port, bytes) in from.try_iter() {
            members[port].0.receive(&bytes, now(began));
        }
        for (number, (robot, next)) in members.iter_mut().enumerate() {
            let moment = now(began);
            if *next <= moment {
                *next = *next + INTERVAL;
                let there = pose(number, moment);
                robot.odometry(moment, there, moment);
                // A robot that lags drops the scan and counts it.
                let _ = robot.scan(moment, &scan(number, moment), moment);
            }
            robot.timeout(moment);
            while let Some(len) = robot.poll_transmit(moment, &mut frame) {
                let _ = to.send((number, frame[..len].to_vec()));
            }
        }
    }
    members.iter().map(|(robot, _)| u64::from(robot.statistics().fixes)).sum()
}
