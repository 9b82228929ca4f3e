//! The main loop of a robot, on a PC: it explores a room by its own odometry, without a server, and
//! prints its map at the end.
//!
//! `cargo run --package ubimap-agent --example main_loop`
//!
//! [`run`] is the part to copy. [`Board`] replaces the hardware: a room of 5 x 4 m, in which time
//! passes only while the robot sleeps.

use std::{array, f64::consts::TAU};

use ubimap_agent::{
    Bounds, Config, ConfigError, Memory, Robot,
    drive::{DriveCommand, Driving, Reason},
    locate::PoseSource,
    memory,
    sense::SensorModel,
};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    message::Waypoint,
    tile::{Cell, TILE_SIDE, TileId},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

/// A lidar with 180 beams, and 32 tiles of 1.6 x 1.6 m: the room touches 20.
const BOUNDS: Bounds = Bounds { readings: 180, own_tiles: 32, fused_tiles: 0, ..Bounds::DEFAULT };
/// The memory that the robot borrows.
type RobotMemory = memory!(BOUNDS, Driving);

fn main() -> Result<(), ConfigError> {
    // On a microcontroller: a `static mut` in the `#[entry]` function.
    let mut memory: Box<RobotMemory> = Box::new(Memory::EMPTY);
    let mut board = Board::default();
    let map = run(&mut board, &mut memory)?;
    println!(
        "{map}\nexplored in {} s; {} frames sent to no server",
        board.now.seconds(),
        board.sent
    );
    Ok(())
}

/// The robot's main loop. It returns when everything is explored; on a real robot it would never
/// return.
fn run(board: &mut Board, memory: &mut RobotMemory) -> Result<String, ConfigError> {
    let mut robot = Robot::new(config(), memory)?;
    let mut bytes = [0; DEFAULT_FRAME];
    while robot.drive().driver().reason() != Reason::Explored {
        board.wait(robot.poll_timeout());
        let count = board.read(&mut bytes);
        robot.receive(&bytes[..count], board.now);
        if let Some((moment, pose)) = board.odometry() {
            robot.odometry(moment, pose, board.now);
        }
        if let Some((taken, readings)) = board.scan() {
            // The robot counts a refused scan and reports it to the server.
            let _ = robot.scan(taken, &readings, board.now);
        }
        robot.timeout(board.now);
        while let Some(count) = robot.poll_transmit(board.now, &mut bytes) {
            board.write(&bytes[..count]);
        }
        board.turn_wheels(robot.command());
    }
    Ok(drawn(&robot))
}

fn config() -> Config<Driving> {
    let step = TAU as f32 / BOUNDS.readings as f32;
    let home = Pose::from_metres(1.0, 1.0, 0.0);
    let alone = Some(Waypoint { x: home.x, y: home.y });
    Config {
        pose_source: PoseSource::Odometry(home),
        ..Config::new(RobotId(1), SensorModel::Radial { first: 0.0, step }, BOUNDS)
    }
    .with_drive(Driving { alone, ..Driving::default() })
}

/// The robot's map with north at the top: `#` is occupied, `.` free, a space unknown.
fn drawn(robot: &Robot<'_, Driving>) -> String {
    let side = TILE_SIDE as i32;
    let cell = |x: i32, y: i32| {
        let tile = TileId::of_cell(x, y).and_then(|id| robot.own_tiles().find(id));
        let within = |cell: i32| cell.rem_euclid(side) as usize;
        match tile.map_or(Cell::Unknown, |tile| tile.cells().cell(within(x), within(y))) {
            Cell::Occupied | Cell::Movable => '#',
            Cell::Free => '.',
            Cell::Unknown => ' ',
        }
    };
    // A character covers two cells of 5 cm, one above the other.
    let both = |x, y| if cell(x, y + 1) == '#' { '#' } else { cell(x, y) };
    let line = |y: i32| (-2..102).map(|x| both(x, y)).collect::<String>();
    (-2..82).step_by(2).rev().map(line).collect::<Vec<_>>().join("\n")
}

/// A mobile base with a lidar in a room, and a port without a peer.
#[derive(Default)]
struct Board {
    now: Instant,
    /// The robot's true pose: metres and radians.
    at: [f64; 3],
    command: DriveCommand,
    /// When the next reading of the wheels and of the lidar is due.
    next: [Instant; 2],
    sent: usize,
}

impl Board {
    /// Sleeps until `due`, or until the wheels or the lidar have a reading.
    fn wait(&mut self, due: Instant) {
        let until = self.next.into_iter().fold(due, Instant::min).max(self.now);
        let seconds = until.since(self.now).micros() as f64 / 1e6;
        let [x, y, heading] = &mut self.at;
        let way = f64::from(self.command.speed) / 1e3 * seconds;
        *heading += f64::from(self.command.turn) / 1e3 * seconds;
        *x += way * heading.cos();
        *y += way * heading.sin();
        self.now = until;
    }

    /// Reads bytes from the server: none here.
    fn read(&mut self, _: &mut [u8]) -> usize {
        0
    }

    /// Sends bytes to the server.
    fn write(&mut self, _: &[u8]) {
        self.sent += 1;
    }

    /// `base_link` in `odom`, 50 times per second.
    fn odometry(&mut self) -> Option<(Instant, Pose)> {
        self.is_due(0, 20)
            .then(|| (self.now, Pose::from_metres(self.at[0], self.at[1], self.at[2])))
    }

    /// Ranges in millimetres, ten times per second.
    fn scan(&mut self) -> Option<(Instant, [u16; BOUNDS.readings])> {
        self.is_due(1, 100).then(|| {
            let turn = |beam: usize| self.at[2] + TAU * beam as f64 / BOUNDS.readings as f64;
            (self.now, array::from_fn(|beam| self.range(turn(beam))))
        })
    }

    /// Sets the speed of the wheels.
    fn turn_wheels(&mut self, command: DriveCommand) {
        self.command = command;
    }

    fn is_due(&mut self, device: usize, millis: u64) -> bool {
        let is_due = self.next[device] <= self.now;
        if is_due {
            self.next[device] = self.now + Duration::from_millis(millis);
        }
        is_due
    }

    /// The lidar's range in a direction.
    fn range(&self, heading: f64) -> u16 {
        // The robot starts at odom's origin, which is at (1, 1) in the room.
        let (x, y) = (self.at[0] + 1.0, self.at[1] + 1.0);
        let (sin, cos) = heading.sin_cos();
        let is_free = |&way: &u16| {
            let (x, y) = (x + f64::from(way) / 1e3 * cos, y + f64::from(way) / 1e3 * sin);
            let is_in_wall = (2.4..2.6).contains(&x) && y < 2.5;
            (0.0..5.0).contains(&x) && (0.0..4.0).contains(&y) && !is_in_wall
        };
        (0..BOUNDS.max_range).step_by(10).find(|way| !is_free(way)).unwrap_or(0)
    }
}
