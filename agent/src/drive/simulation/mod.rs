//! A simulated robot in a room: scans by ray casting, draws its own map, and drives by it.

mod tests;

use std::{boxed::Box, vec, vec::Vec};

use ubimap_protocol::{
    message::Waypoint,
    tile::Row,
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

use super::*;
use crate::sense::{Beam, SensorModel, Validity, fill_beams};

/// Side of a cell in the room and on the map, in millimetres.
const CELL: f64 = 50.0;
/// The side of a letter of the drawing, in cells.
const LETTER: usize = 4;
/// Rows of the map, and tiles per row; larger than any room here.
const ROWS: usize = 320;
const COLUMNS: usize = ROWS / 32;
/// Cells of the map beyond the room on each side.
const EDGE: i32 = 64;
/// Duration of a step, in seconds.
const STEP: f64 = 0.05;
/// The robot's radius in millimetres, without the margin that `Motion::default()` adds.
const RADIUS: f64 = 150.0;
const BEAMS: usize = 192;
const RANGE: f64 = 4_000.0;

/// A room: `#` is a wall. The first line is north.
struct DrawnRoom(Vec<Vec<u8>>);

impl DrawnRoom {
    fn new(drawing: &str) -> Self {
        Self(drawing.split_whitespace().rev().map(|line| line.into()).collect())
    }

    /// Whether a cell is a wall.
    fn is_wall(&self, x: i32, y: i32) -> bool {
        let letter = |it: i32| usize::try_from(it).map(|it| it / LETTER);
        let row = letter(y).ok().and_then(|y| self.0.get(y));
        let letter = row.zip(letter(x).ok()).and_then(|(row, x)| row.get(x));
        letter.is_none_or(|&it| it == b'#')
    }

    /// Distance from a point to the nearest wall, up to 0.5 m.
    fn nearest_wall(&self, x: f64, y: f64) -> f64 {
        let (column, row) = ((x / CELL).floor() as i32, (y / CELL).floor() as i32);
        let about = (-10..=10).flat_map(|dy| (-10..=10).map(move |dx| (column + dx, row + dy)));
        let gap = |at: f64, cell: i32| {
            let (low, high) = (f64::from(cell) * CELL, f64::from(cell + 1) * CELL);
            (low - at).max(at - high).max(0.0)
        };
        let walls = about.filter(|&(x, y)| self.is_wall(x, y));
        let ways = walls.map(|(column, row)| gap(x, column).hypot(gap(y, row)));
        ways.fold(500.0, f64::min)
    }
}

/// A person who walks back and forth between two points, and does not walk into a robot that stands
/// or creeps.
#[derive(Clone, Copy)]
struct Person {
    from: (f64, f64),
    to: (f64, f64),
    /// Distance walked from `from` in millimetres, and whether the person walks back.
    walked: f64,
    back: bool,
    waits: bool,
    /// Whether the person never moves.
    stands: bool,
    /// The velocity that cameras measure of the arms of one who never moves, in mm/s, and whether they
    /// say that this person sits or lies.
    fidgets: f64,
    is_at_rest: bool,
}

impl Person {
    const SPEED: f64 = 1_200.0;
    const RADIUS: f64 = 250.0;

    fn direction(&self) -> (f64, f64) {
        let (x, y) = (self.to.0 - self.from.0, self.to.1 - self.from.1);
        let length = x.hypot(y);
        (x / length, y / length)
    }

    fn at(&self) -> (f64, f64) {
        let direction = self.direction();
        (self.from.0 + direction.0 * self.walked, self.from.1 + direction.1 * self.walked)
    }

    fn velocity(&self) -> (f64, f64) {
        let speed = match self {
            Self { stands: true, fidgets, .. } => *fidgets,
            Self { waits: true, .. } => 0.0,
            Self { back, .. } => Self::SPEED * if *back { -1.0 } else { 1.0 },
        };
        (self.direction().0 * speed, self.direction().1 * speed)
    }

    fn walk(&mut self, robot: (f64, f64), creeps: bool) {
        if self.stands {
            return;
        }
        let length = (self.to.0 - self.from.0).hypot(self.to.1 - self.from.1);
        let before = *self;
        self.walked += if self.back { -STEP } else { STEP } * Self::SPEED;
        if !(0.0..=length).contains(&self.walked) {
            self.back = !self.back;
            self.walked = self.walked.clamp(0.0, length);
        }
        let apart = |it: &Self| (it.at().0 - robot.0).hypot(it.at().1 - robot.1);
        let nearer = apart(self) < apart(&before);
        self.waits = creeps && nearer && apart(self) < RADIUS + Self::RADIUS + 60.0;
        if self.waits {
            (self.walked, self.back) = (before.walked, before.back);
        }
    }
}

/// A fault of the wheels.
#[derive(Clone, Copy, PartialEq)]
enum Wheels {
    Work,
    Blocked,
    Slip,
}

struct Simulation {
    room: DrawnRoom,
    people: Vec<Person>,
    /// Whether cameras report the people to the robot.
    is_told: bool,
    wheels: Wheels,
    /// The sensor's field of view, in radians.
    view: f64,
    link: bool,
    sees: bool,
    stop: bool,
    unsure: f32,
    /// The robot's true pose, in millimetres and radians.
    at: (f64, f64, f64),
    odometry: (f64, f64, f64),
    command: DriveCommand,
    now: Instant,
    heard: Instant,
    near: NearPoints,
    map: Vec<Row>,
    driver: Box<Driver<'static>>,
    told: Vec<Reason>,
    /// Distance driven, and minimum distance from a person's centre, in millimetres.
    way: f64,
    nearest: f64,
}

fn config() -> Driving {
    let motion = Motion { radius: RADIUS as u16, ..Motion::default() };
    Driving { motion, explore_covered: true, ..Driving::default() }
}

/// A driver whose memory is leaked, so that it lives until the test ends.
fn driver() -> Box<Driver<'static>> {
    let workspace = Box::leak(Box::new(Workspace::EMPTY));
    Box::new(Driver::new(config(), Millimetres(CELL as i32), workspace))
}

impl Simulation {
    /// A robot at a position in metres, heading along x.
    fn new(drawing: &str, x: f64, y: f64) -> Self {
        let mut it = Self {
            room: DrawnRoom::new(drawing),
            people: Vec::new(),
            is_told: true,
            wheels: Wheels::Work,
            view: 1.5 * core::f64::consts::PI,
            link: true,
            sees: true,
            stop: false,
            unsure: 20.0,
            at: (x * 1_000.0, y * 1_000.0, 0.0),
            odometry: (0.0, 0.0, 0.0),
            command: DriveCommand::STAND,
            now: Instant(1_000_000),
            heard: Instant(1_000_000),
            near: NearPoints::default(),
            map: vec![Row::default(); ROWS * COLUMNS],
            driver: driver(),
            told: Vec::new(),
            way: 0.0,
            nearest: f64::INFINITY,
        };
        it.look();
        it
    }

    /// Gives the robot a complete map of the room.
    fn with_map(mut self) -> Self {
        for y in 0..ROWS as i32 - EDGE {
            for x in 0..ROWS as i32 - EDGE {
                let is_wall = self.room.is_wall(x, y);
                self.draw(x, y, is_wall);
            }
        }
        self
    }

    fn draw(&mut self, x: i32, y: i32, is_wall: bool) {
        let (x, y) = ((x + EDGE) as usize, (y + EDGE) as usize);
        let Some(row) = self.map.get_mut(y * COLUMNS + x / 32).filter(|_| x < ROWS) else { return };
        let bit = 1 << (x % 32);
        if is_wall {
            (row.low, row.high) = (row.low & !bit, row.high | bit);
        } else if row.high & bit == 0 {
            row.low |= bit;
        }
    }

    fn known(map: &[Row], column: i32, row: i32) -> GroundRow {
        let (column, row) = (column + EDGE / 32, row + EDGE);
        let inside = (0..COLUMNS as i32).contains(&column) && (0..ROWS as i32).contains(&row);
        let index = (row * COLUMNS as i32 + column) as usize;
        let cells = if inside { map[index] } else { Row::default() };
        GroundRow { cells, covered: 0 }
    }

    fn pose((x, y, heading): (f64, f64, f64)) -> Pose {
        Pose::from_metres(x / 1_000.0, y / 1_000.0, heading)
    }

    /// Takes a scan, and draws everything in it except people onto the map.
    fn look(&mut self) {
        let model = SensorModel::Radial {
            first: (-self.view / 2.0) as f32,
            step: (self.view / BEAMS as f64) as f32,
        };
        let mut beams = [Beam::default(); BEAMS];
        fill_beams(&mut beams, model, Pose::default());
        let mut readings = [0; BEAMS];
        let (x, y, heading) = self.at;
        for (index, reading) in readings.iter_mut().enumerate() {
            let bearing = heading - self.view / 2.0 + index as f64 * self.view / BEAMS as f64;
            let (sin, cos) = bearing.sin_cos();
            let mut range = RANGE + 1.0;
            for person in &self.people {
                let (px, py) = (person.at().0 - x, person.at().1 - y);
                let (along, aside) = (px * cos + py * sin, py * cos - px * sin);
                let half = Person::RADIUS.powi(2) - aside.powi(2);
                if along > 0.0 && half > 0.0 {
                    range = range.min(along - half.sqrt());
                }
            }
            let mut way = 0.0;
            while way <= RANGE.min(range) {
                let (at_x, at_y) = (x + cos * way, y + sin * way);
                let (column, row) = ((at_x / CELL).floor() as i32, (at_y / CELL).floor() as i32);
                let is_wall = self.room.is_wall(column, row);
                self.draw(column, row, is_wall);
                if is_wall {
                    range = range.min(way);
                    break;
                }
                way += 12.5;
            }
            if range <= RANGE {
                *reading = range.max(1.0) as u16;
            }
        }
        self.near = NearPoints::of_scan(&Seen {
            taken: self.now,
            readings: &readings,
            beams: &beams,
            validity: Validity::default(),
            mounting: Pose::default(),
        });
    }

    fn step(&mut self) {
        self.now = self.now + Duration::from_millis((STEP * 1_000.0) as u64);
        // The last step's command is executed during this one.
        let (speed, turn) = (f64::from(self.command.speed), f64::from(self.command.turn) / 1_000.0);
        let (speed, turn) = if self.wheels == Wheels::Blocked { (0.0, 0.0) } else { (speed, turn) };
        let moved = |(x, y, heading): (f64, f64, f64)| {
            let middle: f64 = heading + turn * STEP / 2.0;
            (
                x + speed * STEP * middle.cos(),
                y + speed * STEP * middle.sin(),
                heading + turn * STEP,
            )
        };
        self.odometry = moved(self.odometry);
        if self.wheels != Wheels::Slip {
            self.at = moved(self.at);
            self.way += speed * STEP;
        }
        let robot = (self.at.0, self.at.1);
        let wall = self.room.nearest_wall(robot.0, robot.1);
        assert!(wall >= RADIUS, "{wall} mm from a wall at {robot:?}");
        for person in &mut self.people {
            person.walk(robot, speed < 200.0);
            let apart = (person.at().0 - robot.0).hypot(person.at().1 - robot.1);
            self.nearest = self.nearest.min(apart);
            let touches = apart < RADIUS + Person::RADIUS;
            assert!(!touches, "{apart} from a person, at {speed} mm/s, {:?}", self.now);
        }
        // Ten scans a second.
        if self.sees && self.now.micros().is_multiple_of(100_000) {
            self.look();
        }
        if self.link {
            self.heard = self.now;
        }
        let health = Health {
            now: self.now,
            heard: Some(self.heard),
            must_stop: self.stop,
            pose: Some((Self::pose(self.at), self.unsure)),
            odometry: Some(Self::pose(self.odometry)),
            scan: self.near.taken(),
        };
        let movers = self.people.iter().filter(|_| self.is_told).map(|person| Mover {
            x: Millimetres(person.at().0 as i32),
            y: Millimetres(person.at().1 as i32),
            velocity_x: person.velocity().0 as i16,
            velocity_y: person.velocity().1 as i16,
            radius: Person::RADIUS as u16,
            is_person: true,
            is_at_rest: person.is_at_rest,
        });
        let movers = movers.collect::<Vec<_>>();
        let inputs = Inputs { health, near: &self.near, movers: &movers, cells_refused: 0 };
        let map = &self.map;
        self.command = self.driver.step(&inputs, |column, row| Self::known(map, column, row));
        self.told.extend(self.driver.poll_event());
    }

    /// Runs until a reason is reported, at most `seconds`. Returns the elapsed seconds.
    fn until(&mut self, reason: Reason, seconds: f64) -> f64 {
        let start = self.now;
        let elapsed = |it: &Self| it.now.since(start).micros() as f64 * 1.0e-6;
        while self.driver.reason() != reason {
            self.step();
            let at = self.at;
            assert!(elapsed(self) < seconds, "not {reason:?}: {:?}, at {at:?}", self.told);
        }
        elapsed(self)
    }

    fn run(&mut self, seconds: f64) {
        (0..(seconds / STEP) as usize).for_each(|_| self.step());
    }

    fn go(&mut self, x: f64, y: f64) {
        self.driver.set_task(Task::Go(point(x, y)));
    }

    /// The number of cells that the robot's centre can reach in truth, and how many of them the
    /// robot has mapped.
    fn reachable(&self) -> (usize, usize) {
        let start = ((self.at.0 / CELL) as i32, (self.at.1 / CELL) as i32);
        let mut seen = vec![false; ROWS * ROWS];
        let (mut todo, mut all, mut known) = (vec![start], 0, 0);
        while let Some((x, y)) = todo.pop() {
            let index = y as usize * ROWS + x as usize;
            let middle = |at: i32| (f64::from(at) + 0.5) * CELL;
            if seen[index] || self.room.nearest_wall(middle(x), middle(y)) < RADIUS + 65.0 {
                continue;
            }
            seen[index] = true;
            all += 1;
            let row = Self::known(&self.map, x.div_euclid(32), y).cells;
            known += (row.known() >> (x % 32) & 1) as usize;
            todo.extend([(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]);
        }
        (all, known)
    }
}

fn point(x: f64, y: f64) -> Waypoint {
    Waypoint { x: Millimetres::from_metres(x), y: Millimetres::from_metres(y) }
}
