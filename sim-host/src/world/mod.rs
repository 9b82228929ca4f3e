//! The simulated room: walls, furniture, people, robots and ideal cameras.
//!
//! Read in this order: `scenario` (what a TOML file says), `shapes` and `room` (what never moves,
//! and rays through it), `truth` (what a perfect map would say), `route`, `people` and `robots`
//! (what moves), `places` (who can't be or go where), `sensor` and `cameras` (what is measured). [`World`] ties them together.
//!
//! The world moves in steps of [`STEP`], whoever asks it and how often: everything that it reports
//! depends on the scenario, the resolution and the seed alone. Each robot, person and camera throws
//! dice of its own, so that one robot fewer leaves the noise of the others as it was.

mod cameras;
mod people;
mod places;
mod robots;
mod room;
mod route;
mod scenario;
mod sensor;
mod shapes;
mod truth;

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, VecDeque};

use parry2d_f64::glamx::DVec2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

use crate::camera::{Observation, Source};

pub use people::Person;
pub use robots::SimRobot;
pub use room::WallGrid;
pub use scenario::{
    BUILT_IN, CameraConfig, FootprintConfig, FurnitureConfig, OdometryConfig, PersonConfig,
    RobotConfig, RoomConfig, RouteConfig, Scenario, ScenarioError, SensorConfig, StartConfig,
    WallConfig,
};
pub use sensor::RangeSensor;
pub use truth::Truth;

use cameras::{Camera, SeenRobot};
use room::{Cells, Room};
use route::Body;

/// The step in which everything moves; frames and scans are taken at its multiples.
pub const STEP: Duration = Duration::from_millis(10);

/// One scan of one robot.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanEvent {
    /// Which robot, by its index in [`World::robots`].
    pub robot: usize,
    /// When it was taken, in the server's clock.
    pub taken: Instant,
    /// For each beam of the sensor, from right to left, the range in millimetres; zero where
    /// nothing came back.
    pub readings_mm: Vec<u16>,
    /// Where the wheels say the robot was: `base_link` in `odom`.
    pub odometry: Pose,
    /// Where it really was: `base_link` in `map`. For scores only.
    pub truth: Pose,
}

/// The simulated room, and the time in it.
pub struct World {
    room: Room,
    truth: Truth,
    people: Vec<Person>,
    robots: Vec<SimRobot>,
    cameras: Vec<(Camera, FrameTimes)>,
    scanners: Vec<(Cadence, ChaCha8Rng)>,
    now: Instant,
    scans: VecDeque<ScanEvent>,
    /// Frames under way, by arrival, then capture, then camera.
    frames: BTreeMap<(Instant, Instant, usize), Observation>,
}

impl World {
    /// A world at its first moment. `walls` are those of the map that the scenario names, if it
    /// names one; `resolution` is the side of a cell of the map.
    pub fn new(
        scenario: &Scenario,
        walls: Option<&WallGrid>,
        resolution: Millimetres,
        seed: u64,
    ) -> Result<Self, ScenarioError> {
        scenario.check()?;
        if resolution.0 <= 0 {
            let problem = format!("needs cells of a positive side, not {} mm", resolution.0);
            return Err(scenario.invalid("room", problem));
        }
        let room = Room::new(scenario, walls)?;
        let cells = Cells::of(&room, resolution.metres(), scenario)?;
        places::check(scenario, &room)?;
        let starts: Vec<DVec2> = scenario.robots.iter().map(places::start).collect();
        let truth = truth::truth(&room, cells, scenario.slice_height_m, &starts);
        let dice = |who: Dice, number: usize| {
            let mut dice = ChaCha8Rng::seed_from_u64(seed);
            dice.set_stream((who as u64) << 32 | number as u64);
            dice
        };
        let cameras = scenario.cameras.iter().enumerate().map(|(index, config)| {
            let dice = dice(Dice::Camera, index);
            let camera = Camera::new(config, &room, cells, scenario.robot_height_m(), dice);
            (camera, FrameTimes::new(config))
        });
        let people = scenario.people.iter().enumerate();
        let robots = || scenario.robots.iter().enumerate();
        let mut world = Self {
            cameras: cameras.collect(),
            people: people
                .map(|(index, config)| Person::new(config, dice(Dice::Person, index)))
                .collect(),
            robots: robots()
                .map(|(index, config)| {
                    SimRobot::new(config, index, dice(Dice::Odometry, config.id.into()))
                })
                .collect(),
            scanners: robots()
                .map(|(_, config)| {
                    (Cadence::new(config.sensor.rate_hz), dice(Dice::Scan, config.id.into()))
                })
                .collect(),
            room,
            truth,
            now: Instant::default(),
            scans: VecDeque::new(),
            frames: BTreeMap::new(),
        };
        world.measure();
        Ok(world)
    }

    /// Moves everything to the last step that is not after `to`. Going back does nothing.
    pub fn advance(&mut self, to: Instant) {
        while self.now + STEP <= to {
            self.now = self.now + STEP;
            self.step();
            self.measure();
        }
    }

    /// The moment that everything has been moved to.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// The robots as they are now, in the order of the scenario.
    pub fn robots(&self) -> &[SimRobot] {
        &self.robots
    }

    /// The people as they are now, in the order of the scenario.
    pub fn people(&self) -> &[Person] {
        &self.people
    }

    /// What a perfect map would say.
    pub fn truth(&self) -> &Truth {
        &self.truth
    }

    /// The next scan that was taken by `now`, oldest first; moves the world that far.
    #[must_use]
    pub fn poll_scan(&mut self, now: Instant) -> Option<ScanEvent> {
        self.advance(now);
        let is_taken = self.scans.front().is_some_and(|scan| scan.taken <= now);
        if is_taken { self.scans.pop_front() } else { None }
    }

    /// When the next scan will be there, or `None` without robots.
    pub fn next_scan(&self) -> Option<Instant> {
        let waiting = self.scans.front().map(|scan| scan.taken);
        waiting.or_else(|| self.scanners.iter().map(|(cadence, _)| cadence.due()).min())
    }

    /// The cells that a camera sees when nobody is there: the ground that is not blind.
    pub fn covered(&self, camera: usize) -> Vec<(i32, i32)> {
        let views = self.cameras.get(camera).map_or(&[][..], |(camera, _)| camera.views());
        views.iter().map(|view| view.cell).collect()
    }

    /// Everybody takes a step, one after the other, so that each knows where the others are.
    fn step(&mut self) {
        let seconds = STEP.micros() as f64 / 1e6;
        for index in 0..self.people.len() {
            let others = self.bodies(None, Some(index));
            self.people[index].step(seconds, &others);
        }
        for index in 0..self.robots.len() {
            let others = self.bodies(Some(index), None);
            self.robots[index].step(seconds, &others);
        }
    }

    /// Takes the scans and frames that are due now.
    fn measure(&mut self) {
        for index in 0..self.robots.len() {
            if !self.scanners[index].0.is_due(self.now) {
                continue;
            }
            let others = self.bodies(Some(index), None);
            let robot = &self.robots[index];
            let dice = &mut self.scanners[index].1;
            let readings_mm = robot.sensor().scan(robot.pose(), &self.room, &others, dice);
            self.scans.push_back(ScanEvent {
                robot: index,
                taken: self.now,
                readings_mm,
                odometry: robot.odometry(),
                truth: robot.truth(),
            });
        }
        for (index, (camera, times)) in self.cameras.iter_mut().enumerate() {
            if !times.frames.is_due(self.now) {
                continue;
            }
            let with_cells = times.cells.is_due(self.now);
            let robots: Vec<SeenRobot> = self.robots.iter().map(SeenRobot::of).collect();
            let people: Vec<Body> = self.people.iter().map(Person::body).collect();
            let frame = camera.frame(&self.room, &robots, &people, with_cells);
            let observation = Observation {
                camera: index,
                captured: self.now,
                robots: frame.robots,
                cells: frame.cells,
            };
            self.frames.insert((self.now + times.latency, self.now, index), observation);
        }
    }

    /// Everybody but one.
    fn bodies(&self, but_robot: Option<usize>, but_person: Option<usize>) -> Vec<Body> {
        let robots = self.robots.iter().map(SimRobot::body).enumerate();
        let people = self.people.iter().map(Person::body).enumerate();
        robots
            .filter(|&(index, _)| Some(index) != but_robot)
            .chain(people.filter(|&(index, _)| Some(index) != but_person))
            .map(|(_, body)| body)
            .collect()
    }
}

/// Polling moves the world to `now`.
impl Source for World {
    fn poll(&mut self, now: Instant) -> Option<Observation> {
        self.advance(now);
        let first = self.frames.first_entry()?;
        (first.key().0 <= now).then(|| first.remove())
    }

    fn next_arrival(&self) -> Option<Instant> {
        let under_way = self.frames.keys().map(|&(arrival, ..)| arrival).next();
        let coming = self.cameras.iter().map(|(_, times)| times.frames.due() + times.latency).min();
        under_way.into_iter().chain(coming).min()
    }
}

/// Who throws dice; each of a kind has a number besides.
#[derive(Clone, Copy)]
enum Dice {
    Camera = 1,
    Person = 2,
    Odometry = 3,
    Scan = 4,
}

/// Something that happens so many times a second, at steps.
struct Cadence {
    rate: f64,
    count: u64,
}

impl Cadence {
    fn new(rate: f64) -> Self {
        Self { rate, count: 0 }
    }

    /// The step at or after the exact moment: a rate is kept on average.
    fn due(&self) -> Instant {
        let steps = self.count as f64 / self.rate * 1e6 / STEP.micros() as f64;
        // Ten hertz are exactly ten steps, whatever the division says.
        Instant::from_micros((steps - 1e-6).ceil().max(0.0) as u64 * STEP.micros())
    }

    /// Whether it happens now; if so, it is due again later.
    fn is_due(&mut self, now: Instant) -> bool {
        let is_due = self.due() <= now;
        self.count += u64::from(is_due);
        is_due
    }
}

/// When a camera takes frames, which of them say something about cells, and when they arrive.
struct FrameTimes {
    frames: Cadence,
    cells: Cadence,
    latency: Duration,
}

impl FrameTimes {
    fn new(config: &CameraConfig) -> Self {
        Self {
            frames: Cadence::new(config.rate_hz),
            cells: Cadence::new(config.cells_rate_hz),
            latency: Duration::from_micros((config.latency_ms * 1000.0).round() as u64),
        }
    }
}
