//! The simulated room: walls, furniture, doors, people, robots and cameras.
//!
//! Read in this order: `scenario` (the TOML file) and `growth` (generated from a map), `shapes` and `room`
//! (static geometry and ray casting), `changes` (scheduled changes), `truth` (the perfect map),
//! `plane_pose`, `route`, `people` and `robots` (motion; `marker` and `tag`: markers on robots), `places`
//! (checks of starts and routes), `odometer` (what wheels report), `stereo` and `sensor` (range sensors), `glare` (badly exposed pixels), `grey_eye` (grey cameras of robots), `mounting`, `displacement`, `render`
//! and `filming` (camera frames), `passed` (ground that robots have seen), `reachable` (ground where robots
//! can stand), `ideal_camera` and `ideal_cameras` (observations without frames). [`World`] combines them.
//!
//! The world moves in steps of [`STEP`], however it is polled: all results depend only on the scenario, the
//! resolution and the seed. Each robot, person and camera has its own random numbers (`streams`).

mod cadence;
mod changes;
mod displacement;
mod filming;
mod fixed_parts;
mod glare;
mod grey_eye;
mod growth;
mod ideal_camera;
mod ideal_cameras;
mod marker;
mod mounting;
mod odometer;
mod passed;
mod people;
mod places;
mod plane_pose;
mod reachable;
mod render;
mod robots;
mod room;
mod route;
mod scenario;
mod sensor;
mod shapes;
mod stereo;
mod streams;
pub mod tag;
mod tour;
mod truth;

#[cfg(test)]
mod tests;

use std::{collections::VecDeque, sync::Arc};

use log::info;
use parry2d_f64::glamx::DVec2;
use rand_chacha::ChaCha8Rng;
use ubimap_protocol::{
    time::Instant,
    units::{Millimetres, Pose},
};

use crate::camera::{Calibration, Frame, FrameSource, Observation, Source};

pub use cadence::STEP;
pub use fixed_parts::{FixedOutline, FixedPart};
pub use grey_eye::{LookEvent, pictures_of_a_board};
pub use people::Person;
pub use robots::SimRobot;
pub use room::WallGrid;
pub use scenario::{
    BUILT_IN, CameraConfig, DepthConfig, DoorConfig, FootprintConfig, FurnitureConfig, GlareConfig,
    GrowConfig, KnockConfig, MarkerConfig, MoveConfig, NAMED, OdometryConfig, PersonConfig,
    PictureConfig, PostureConfig, RobotConfig, RoomConfig, RouteConfig, Scenario, ScenarioError,
    SensorConfig, SensorPreset, StartConfig, WallConfig,
};
pub use sensor::RangeSensor;
pub use tag::TAGS;
pub use truth::Truth;

use cadence::Cadence;
use changes::Changes;
use filming::Filming;
use glare::Glare;
use grey_eye::GreyEye;
use ideal_cameras::IdealCameras;
use odometer::Odometer;
use passed::Passed;
use render::{Part, Scene};
use robots::Contact;
use room::{CellGrid, Room};
use route::Body;
use shapes::Prism;
use streams::Stream;

/// One scan of one robot.
#[derive(Clone, Debug, PartialEq)]
pub struct ScanEvent {
    /// The robot's index in [`World::robots`].
    pub robot: usize,
    /// When it was taken, in the server's clock.
    pub taken: Instant,
    /// Range of each beam of the sensor in millimetres, from right to left; zero for no return.
    pub readings_mm: Vec<u16>,
    /// Brightness of each column's pixel, for stereo cameras in rooms with glare; otherwise empty.
    pub light: Vec<u8>,
    /// Odometry of the robot: `base_link` in `odom`.
    pub odometry: Pose,
    /// True pose: `base_link` in `map`. For scoring only.
    pub truth: Pose,
}

/// Numbers of contacts of the robots that are driven by commands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Contacts {
    /// Contacts with walls, furniture and other robots.
    pub collisions: u64,
    /// Contacts with people.
    pub touches: u64,
}

/// The simulated room with its clock.
pub struct World {
    room: Arc<Room>,
    changes: Changes,
    cells: CellGrid,
    slice_height: f64,
    starts: Vec<DVec2>,
    truth: Truth,
    passed: Passed,
    people: Vec<Person>,
    robots: Vec<SimRobot>,
    cameras: IdealCameras,
    filming: Filming,
    scanners: Vec<(Cadence, ChaCha8Rng)>,
    now: Instant,
    contacts: Contacts,
    scans: VecDeque<ScanEvent>,
    /// The grey camera of each robot that has one and drives.
    eyes: Vec<Option<GreyEye>>,
    looks: VecDeque<LookEvent>,
    glare: Glare,
}

/// Clearance of a tour, in metres: its lines pass the centres of its cells at up to half their diagonal.
const TOUR_CLEARANCE_M: f64 = 0.08;

impl World {
    /// A world at time zero. `walls` are those of the scenario's map, if it names one; `resolution` is the
    /// side of a map cell.
    ///
    /// # Errors
    /// [`ScenarioError::Invalid`] for impossible numbers, places and paths.
    pub fn new(
        scenario: &Scenario,
        walls: Option<&WallGrid>,
        resolution: Millimetres,
        seed: u64,
    ) -> Result<Self, ScenarioError> {
        scenario.check()?;
        if resolution.0 <= 0 {
            let problem = format!("needs cells with a positive side, not {} mm", resolution.0);
            return Err(scenario.invalid("room", problem));
        }
        let changes = Changes::new(scenario, walls);
        let room = changes.room()?;
        let cells = CellGrid::of(&room, resolution.metres(), scenario)?;
        for room in changes.rooms() {
            places::check(scenario, &room?)?;
        }
        let starts: Vec<DVec2> = scenario.robots.iter().map(places::start).collect();
        let before = Truth::default();
        let truth = truth::truth(&room, cells, scenario.slice_height_m, &starts, &before);
        let cameras =
            IdealCameras::new(scenario, &room, cells, |index| Stream::Camera.rng(seed, index));
        let in_colour = scenario.robots.iter().any(|robot| robot.marker == MarkerConfig::Colour);
        let filming =
            Filming::new(&scenario.cameras, in_colour, |index| Stream::Frame.rng(seed, index));
        let filming = filming.map_err(|(index, error)| {
            scenario.invalid(format!("cameras[{index}]"), format!("has {error}"))
        })?;
        let people = scenario.people.iter().enumerate();
        let people = people
            .map(|(index, config)| Person::new(config, index, Stream::Person.rng(seed, index)));
        let robots = scenario.robots.iter().enumerate().map(|(index, config)| {
            let [noise, wheels] =
                [Stream::Odometry, Stream::Wheels].map(|it| it.rng(seed, config.id.into()));
            SimRobot::new(config, index, Odometer::new(&config.odometry, noise, wheels))
        });
        let robots: Vec<SimRobot> = robots.collect();
        let eyes = robots.iter().map(|robot| {
            let sees = robot.sensor().sees_grey() && robot.drives();
            let dice = Stream::Eye.rng(seed, robot.id().0.into());
            sees.then(|| GreyEye::new(robot.sensor(), dice)).flatten()
        });
        let eyes = eyes.collect();
        let scanners = scenario.robots.iter().map(|config| {
            (Cadence::new(config.sensor.rate_hz), Stream::Scan.rng(seed, config.id.into()))
        });
        let mut world = Self {
            cameras,
            people: people.collect(),
            robots,
            scanners: scanners.collect(),
            room: Arc::new(room),
            changes,
            cells,
            slice_height: scenario.slice_height_m,
            starts,
            truth,
            passed: Passed::new(cells, scenario.robots.len()),
            filming,
            now: Instant::default(),
            contacts: Contacts::default(),
            scans: VecDeque::new(),
            eyes,
            looks: VecDeque::new(),
            glare: Glare::of(scenario),
        };
        world.measure();
        Ok(world)
    }

    /// Advances to the last step not after `to`. An earlier time does nothing.
    pub fn advance(&mut self, to: Instant) {
        while self.now + STEP <= to {
            self.now = self.now + STEP;
            self.step();
            self.measure();
        }
    }

    /// The time up to which the world has advanced.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// The robots in their present state, in the order of the scenario.
    pub fn robots(&self) -> &[SimRobot] {
        &self.robots
    }

    /// Drives a robot at a speed in m/s and a turn rate in rad/s from now on; the robot leaves its
    /// route.
    pub fn tell_wheels(&mut self, robot: usize, speed_m_s: f64, turn_rad_s: f64) {
        if let Some(robot) = self.robots.get_mut(robot) {
            robot.tell_wheels(speed_m_s, turn_rad_s);
        }
    }

    /// The contacts so far of robots that are driven by commands.
    pub fn contacts(&self) -> Contacts {
        self.contacts
    }

    /// The people in their present state, in the order of the scenario.
    pub fn people(&self) -> &[Person] {
        &self.people
    }

    /// The perfect map of the present room.
    pub fn truth(&self) -> &Truth {
        &self.truth
    }

    /// The next scan taken by `now`, oldest first; advances the world to `now`.
    #[must_use]
    pub fn poll_scan(&mut self, now: Instant) -> Option<ScanEvent> {
        self.advance(now);
        let is_taken = self.scans.front().is_some_and(|scan| scan.taken <= now);
        if is_taken { self.scans.pop_front() } else { None }
    }

    /// The next picture of a robot's grey camera taken by `now`, oldest first; advances the world to
    /// `now`.
    #[must_use]
    pub fn poll_look(&mut self, now: Instant) -> Option<LookEvent> {
        self.advance(now);
        let is_taken = self.looks.front().is_some_and(|look| look.taken <= now);
        if is_taken { self.looks.pop_front() } else { None }
    }

    /// Drops the rendered cameras' frames that have arrived by `now`, for callers that do not poll them.
    pub fn skip_frames(&mut self, now: Instant) {
        self.filming.skip(now);
    }

    /// When the next scan is available; `None` without robots.
    pub fn next_scan(&self) -> Option<Instant> {
        let looks = self.looks.front().map(|look| look.taken);
        let waiting = self.scans.front().map(|scan| scan.taken).into_iter().chain(looks).min();
        waiting.or_else(|| self.scanners.iter().map(|(cadence, _)| cadence.due()).min())
    }

    /// Distance in metres from a point to the first surface of the room in the direction of another one, at
    /// a height; `None` if there is none within 20 m.
    pub fn range_m(&self, from: [f64; 2], towards: [f64; 2], height_m: f64) -> Option<f64> {
        let way = (DVec2::from(towards) - DVec2::from(from)).normalize_or_zero();
        let hit = self.room.first_hit(DVec2::from(from).extend(height_m), way.extend(0.0), 20.0);
        hit.map(|(_, range)| range)
    }

    /// The walls, closed doors and furniture of its scenario as they stand now.
    pub fn fixed_parts(&self, scenario: &Scenario) -> Vec<FixedPart> {
        fixed_parts::parts(&self.room, scenario)
    }

    /// The cells that a camera sees without people and robots.
    pub fn covered(&self, camera: usize) -> Vec<(i32, i32)> {
        self.cameras.visible(camera).collect()
    }

    /// The cells that robots of this radius can cover, coming from the starts of those that have a route
    /// and keeping a clearance of `room_m`; both in metres. Sorted.
    pub fn reachable(&self, radius_m: f64, room_m: f64) -> Vec<(i32, i32)> {
        let height = self.robots.iter().map(SimRobot::height_m).fold(0.0, f64::max);
        let (driving, standing): (Vec<_>, Vec<_>) =
            self.robots.iter().zip(&self.starts).partition(|(robot, _)| robot.drives());
        let standing: Vec<Body> = standing.into_iter().map(|(robot, _)| robot.body()).collect();
        let starts = driving.into_iter().map(|(_, &start)| start);
        let sizes = [radius_m, room_m, height];
        reachable::ground(&self.room, self.cells, starts, &standing, sizes)
    }

    /// The stops of a closed tour of the first robot from its start through the overlaps of all
    /// pictures, in metres, without the start. Empty if there is none.
    pub fn tour(&self) -> Vec<[f64; 2]> {
        let (Some(robot), Some(&start)) = (self.robots.first(), self.starts.first()) else {
            return Vec::new();
        };
        let apart = robot.body().radius + TOUR_CLEARANCE_M;
        let height = robot.height_m();
        let starts = std::iter::once(start);
        let free = reachable::ground(&self.room, self.cells, starts, &[], [0.0, apart, height]);
        let lenses = self.filming.calibrations().iter().filter_map(|camera| camera.picture);
        let lenses: Vec<_> = lenses.collect();
        let free = free.into_iter().collect();
        let start = self.cells.cell_at(start);
        let stops = tour::tour(&self.room, self.cells, &lenses, &free, start, height);
        stops.into_iter().map(Into::into).collect()
    }

    /// The cells whose centres have been within three metres of a robot's sensor, in its field of view (as
    /// really mounted) and in its line of sight.
    pub fn passed(&self) -> impl Iterator<Item = (i32, i32)> {
        self.passed.cells(self.cells)
    }

    /// Advances by a step. People and robots move in turn, so that each knows where the others are.
    fn step(&mut self) {
        let seconds = STEP.micros() as f64 / 1e6;
        if let Some(room) = self.changes.make(self.now, &self.bodies(None, None)) {
            self.room = Arc::new(room);
            self.truth =
                truth::truth(&self.room, self.cells, self.slice_height, &self.starts, &self.truth);
            self.cameras.look_again(&self.room);
        }
        for index in 0..self.people.len() {
            let mut others = self.bodies(None, Some(index));
            others.extend(self.changes.barriers());
            self.people[index].step(seconds, &others);
        }
        for index in 0..self.robots.len() {
            if self.robots[index].is_told() {
                self.obey(index, seconds);
                continue;
            }
            let mut others = self.bodies(Some(index), None);
            others.extend(self.changes.barriers());
            self.robots[index].step(seconds, &others);
        }
    }

    /// Moves a robot by its commanded speeds.
    fn obey(&mut self, index: usize, seconds: f64) {
        let people: Vec<Body> = self.people.iter().map(Person::body).collect();
        let others = self.robots.iter().enumerate().filter(|(other, _)| *other != index);
        let robots: Vec<Body> = others.map(|(_, robot)| robot.body()).collect();
        // Closed doors are parts of the room.
        let room = &self.room;
        let contact = |me: Body, next: DVec2| {
            let meets = |other: &Body| me.meets(next, other);
            if people.iter().any(meets) {
                return Some(Contact::Person);
            }
            let wall = || room.obstacle(me.centre, next, me.radius, me.height).is_some();
            (robots.iter().any(meets) || wall()).then_some(Contact::Thing)
        };
        let (count, what) = match self.robots[index].obey(seconds, contact) {
            Some(Contact::Person) => (&mut self.contacts.touches, "a person"),
            Some(Contact::Thing) => (&mut self.contacts.collisions, "a robot or a wall"),
            None => return,
        };
        *count += 1;
        let (at, robot) = (self.now.micros() as f64 / 1e6, &self.robots[index]);
        let DVec2 { x, y } = robot.pose().position;
        info!("at {at:.1} s: robot {} touches {what} at {x:.2} m, {y:.2} m", robot.id().0);
    }

    /// Takes the scans and frames that are due.
    fn measure(&mut self) {
        for index in 0..self.robots.len() {
            if !self.scanners[index].0.is_due(self.now) {
                continue;
            }
            let others = self.others(index);
            let robot = &self.robots[index];
            let dice = &mut self.scanners[index].1;
            self.passed.look(index, robot, &self.room, self.cells);
            let readings_mm = robot.sensor().scan(robot.pose(), &self.room, &others, dice);
            if robot.sensor().sees_grey() {
                self.look(index, readings_mm);
                continue;
            }
            let mut readings_mm = readings_mm;
            let light = if self.glare.is_empty() {
                Vec::new()
            } else {
                let robot = &self.robots[index];
                let dice = &mut self.scanners[index].1;
                self.glare.expose(robot.sensor(), robot.pose(), &mut readings_mm, dice)
            };
            let robot = &self.robots[index];
            self.scans.push_back(ScanEvent {
                robot: index,
                taken: self.now,
                readings_mm,
                light,
                odometry: robot.odometry(),
                truth: robot.truth(),
            });
        }
        self.cameras.take(self.now, &self.room, &self.robots, &self.people);
        self.filming.take(self.now, || scene(&self.room, &self.robots, &self.people));
    }

    /// Takes a picture with a robot's grey camera, if it has one that looks.
    fn look(&mut self, index: usize, depths_mm: Vec<u16>) {
        let (Some(eye), Some(robot)) = (self.eyes[index].as_mut(), self.robots.get(index)) else {
            return;
        };
        let others = self.robots.iter().enumerate().filter(|&(other, _)| other != index);
        let moving = others.map(|(_, robot)| robot.part());
        let moving = moving.chain(self.people.iter().flat_map(Person::parts)).collect();
        let scene = Scene { room: self.room.clone(), moving };
        if let Some(picture) = eye.look(robot.sensor(), robot.pose(), &scene) {
            let (taken, truth) = (self.now, robot.truth());
            self.looks.push_back(LookEvent { robot: index, taken, picture, depths_mm, truth });
        }
    }

    /// The prisms of the other robots and of people, as seen by a robot's sensor.
    fn others(&self, but: usize) -> Vec<Prism> {
        let robots = self.robots.iter().enumerate().filter(|&(index, _)| index != but);
        let robots = robots.map(|(_, robot)| robot.part());
        let people = self.people.iter().flat_map(Person::parts);
        robots.chain(people).map(|Part { prism, .. }| prism).collect()
    }

    /// The bodies of all but one.
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

/// Polling advances the world to `now`.
impl Source for World {
    fn poll(&mut self, now: Instant) -> Option<Observation> {
        self.advance(now);
        self.cameras.poll(now)
    }

    fn next_arrival(&self) -> Option<Instant> {
        self.cameras.next_arrival()
    }
}

/// Everything that cameras can see.
fn scene(room: &Arc<Room>, robots: &[SimRobot], people: &[Person]) -> Scene {
    let robots = robots.iter().map(SimRobot::part);
    let moving = robots.chain(people.iter().flat_map(Person::parts)).collect();
    Scene { room: room.clone(), moving }
}

/// Polling advances the world to `now`. Frames are rendered only when polled.
impl FrameSource for World {
    fn cameras(&self) -> &[Calibration] {
        self.filming.calibrations()
    }

    fn poll(&mut self, now: Instant) -> Option<Frame> {
        self.advance(now);
        self.filming.poll(now)
    }

    fn next_arrival(&self) -> Option<Instant> {
        self.filming.next_arrival()
    }
}
