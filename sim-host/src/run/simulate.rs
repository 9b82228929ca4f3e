//! `ubimap simulate`: robots in a simulated room.

use std::{collections::VecDeque, path::Path, time};

use ubimap_agent::{Bounds, Config, Memory, drive::DriveCommand, sense::SensorModel};
use ubimap_protocol::{
    tile::Cell,
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

use super::{
    Outcome, RunError,
    driving::{self, BlindGround},
    figures,
    fleet::{Event, Fleet, Stage},
    heap::BOUNDS,
    options::SimulateOptions,
    progress::Progress,
    record::{Recorded, Recording},
    registry::{RegisteredRobot, Registry},
    scoring::{self, TRACK_INTERVAL},
    time_lapse::{self, TimeLapse},
};
use crate::{
    camera::{FrameSource, Source},
    grid::{self, OccupancyGrid},
    perception::markers::Hue,
    report::{self, Marker, MarkerKind},
    world::{MarkerConfig, RobotConfig, STEP, Scenario, SimRobot, WallGrid, World},
};

/// The side of the map's cells.
pub const RESOLUTION: Millimetres = Millimetres(50);

/// Runs a scenario.
pub fn run(options: &SimulateOptions) -> Result<Outcome, RunError> {
    let started = time::Instant::now();
    let mut scenario = Scenario::read_with(&options.scenario, options.map.as_deref())?;
    let map = scenario.room.map.as_deref().map(straight_map).transpose()?;
    let walls = map.as_ref().map(wall_grid);
    if let (Some(map), Some(walls)) = (&map, &walls) {
        let free: Vec<bool> = map.cells().iter().map(|&cell| cell == Cell::Free).collect();
        scenario.grow_in(walls, &free)?;
    }
    if let Some(robots) = options.robots {
        let asked = usize::from(robots);
        if asked > scenario.robots.len() {
            return Err(RunError::TooManyRobots { asked, there: scenario.robots.len() });
        }
        scenario.robots.truncate(asked);
    }
    let world = World::new(&scenario, walls.as_ref(), RESOLUTION, options.run.seed)?;

    let own_tiles = options.run.tiles.map_or(BOUNDS.own_tiles, |tiles| tiles as usize);
    let configs = world.robots().iter().map(|robot| {
        let driving = driving::driving(robot, options.motion).filter(|_| !options.scripted);
        let mut config = config(robot, options.run.seed).with_drive(driving);
        config.bounds.own_tiles = own_tiles;
        config
    });
    let configs: Vec<_> = configs.collect();
    let mut memory: Vec<_> = configs.iter().map(|it| Memory::new(&it.bounds)).collect();
    let faults = options.run.channel.faults();
    let keeper = options.run.keeper(RESOLUTION)?;
    let mut fleet =
        Fleet::new(&configs, &mut memory, faults, RESOLUTION, options.run.seed, keeper)?;

    let registry = registry(&scenario);
    for (robot, footprint) in registry.footprints() {
        fleet.set_footprint(robot, footprint);
    }
    let cameras = FrameSource::cameras(&world);
    if !options.ideal_cameras {
        fleet.look_through(registry.observer(cameras, RESOLUTION)?);
    }
    let recording = options.record.as_deref();
    let recording = recording.map(|folder| Recording::create(folder, cameras, &registry));
    let recording = recording.transpose()?;
    let duration = options
        .duration
        .unwrap_or(Duration::from_micros((scenario.duration_s * 1e6).round() as u64));
    let end = Instant(0) + duration;
    let mut stage =
        if options.ideal_cameras { Room::new(world, end) } else { Room::filmed(world, end) };
    let progress = Progress::new(stage.end, options.run.json);
    let ground = BlindGround::of(&stage.world);
    let mut time_lapse = options.run.out.is_some().then(|| TimeLapse::new(duration));
    if !options.scripted {
        driving::coordinate(&mut fleet, &stage.world);
        stage.hand_over();
    }
    let mut stage = Recorded { stage, recording };
    let converged = fleet.run(&mut stage, |fleet| {
        progress.at(Instant(0) + fleet.elapsed());
        ground.look(fleet);
        if let Some(time_lapse) = &mut time_lapse {
            time_lapse.look(fleet);
        }
    })?;
    progress.finish();
    let stage = stage.finish()?;

    let map = time_lapse::grid(&fleet)?;
    let mut summary = figures::report(&fleet, &map, options.run.seed, converged, own_tiles);
    summary.truth = Some(scoring::score(&map, &stage.world)?);
    summary.pose = Some(scoring::pose_errors(&fleet, &stage.tracks));
    let sighted = scoring::sighting_errors(&fleet, &stage.tracks);
    summary.sighted = (!options.ideal_cameras).then_some(sighted);
    summary.driving = Some(ground.summary(&fleet, &stage.world));
    summary.simulated_s = fleet.elapsed().micros() as f64 / 1e6;
    summary.elapsed_s = started.elapsed().as_secs_f64();
    let mut markers = figures::markers(&fleet);
    markers.extend(stage.world.people().iter().map(|person| {
        let [x_m, y_m] = person.position_m();
        Marker { kind: MarkerKind::Person, x_m, y_m, heading_rad: 0.0, path: Vec::new() }
    }));
    let coverage = fleet.server().coverage();
    let coverage =
        OccupancyGrid::from_tiles(coverage.tiles().map(|(id, _, tile)| (id, tile)), RESOLUTION)?;
    let mut pictures = vec![
        ("coverage.png", report::render_coverage(&map, &coverage)),
        ("error.png", scoring::error_picture(&map, &stage.world)?),
    ];
    pictures.extend(time_lapse.map(|it| ("timelapse.png", it.picture(&map))));
    Ok(Outcome { report: summary, map, markers, pictures, tables: Vec::new() })
}

/// The configuration of a simulated robot that does not drive itself.
pub fn config(robot: &SimRobot, seed: u64) -> Config {
    let sensor = robot.sensor();
    let model = match sensor.focal_px() {
        Some(focal) => {
            SensorModel::Pinhole { focal: focal as f32, centre: (sensor.beams() - 1) as f32 / 2.0 }
        }
        None => SensorModel::Radial {
            first: sensor.first_angle_rad() as f32,
            step: sensor.step_rad() as f32,
        },
    };
    let bounds = Bounds {
        readings: sensor.beams(),
        resolution: RESOLUTION,
        max_range: (sensor.max_range_m() * 1000.0).clamp(0.0, f64::from(u16::MAX)) as u16,
        ..BOUNDS
    };
    Config {
        mounting: sensor.mount(),
        boot_nonce: seed as u32 ^ u32::from(robot.id().0) << 16,
        ..Config::new(robot.id(), model, bounds)
    }
}

/// The robots of a scenario.
pub fn registry(scenario: &Scenario) -> Registry {
    Registry { robots: scenario.robots.iter().map(registered).collect() }
}

fn registered(robot: &RobotConfig) -> RegisteredRobot {
    let &RobotConfig { id, radius_m, height_m, box_m, marker, marker_size_m, tag_id, .. } = robot;
    let (tag_id, colours) = match marker {
        MarkerConfig::Tag => (tag_id, None),
        MarkerConfig::Colour => (None, Some(robot.colours().map(|colour| Hue::ALL[colour]))),
    };
    let box_m = box_m.unwrap_or([2.0 * radius_m; 2]);
    RegisteredRobot { tag_id, colours, ..RegisteredRobot::new(id, marker_size_m, height_m, box_m) }
}

/// A ROS map that lies straight.
fn straight_map(yaml: &Path) -> Result<OccupancyGrid, RunError> {
    let map = grid::read_map(yaml)?;
    if map.yaw_rad() != 0.0 {
        return Err(RunError::TurnedMap { path: yaml.to_owned(), yaw_rad: map.yaw_rad() });
    }
    Ok(map)
}

/// The occupied cells of a map as walls.
fn wall_grid(map: &OccupancyGrid) -> WallGrid {
    WallGrid {
        resolution_m: map.resolution_m(),
        origin_m: map.origin_m(),
        width: map.width(),
        height: map.height(),
        occupied: map.cells().iter().map(|&cell| cell == Cell::Occupied).collect(),
    }
}

/// A robot reads its wheels at 20 Hz.
const ODOMETRY_INTERVAL: Duration = Duration::from_millis(50);

/// When a robot reads its wheels first: on a real robot they are read when the scans are not, and
/// when the drive makes no step.
fn first_odometry(robot: usize) -> Instant {
    let phases = ODOMETRY_INTERVAL.0 / STEP.0 - 1;
    Instant((1 + robot as u64 * 3 % phases) * STEP.0)
}

/// The simulated room as a source of events.
pub struct Room {
    world: World,
    end: Instant,
    /// When each robot reads its wheels next.
    next_odometry: Vec<Instant>,
    next_track: Instant,
    waiting: VecDeque<Event>,
    /// Whether the cameras give frames; what ideal ones see otherwise.
    is_filmed: bool,
    /// What wheels have been told and do not do yet, by time: when, and which robot's.
    commands: VecDeque<(Instant, usize, DriveCommand)>,
    /// Where each robot really was, every [`TRACK_INTERVAL`].
    tracks: Vec<Vec<Pose>>,
}

impl Room {
    /// The events of a world until some moment, with ideal cameras: nothing is drawn and nothing
    /// looked at, what is in view is known.
    pub fn new(world: World, end: Instant) -> Self {
        let robots = world.robots().len();
        Self {
            world,
            end,
            next_odometry: (0..robots).map(first_odometry).collect(),
            next_track: Instant(0),
            waiting: VecDeque::new(),
            is_filmed: false,
            commands: VecDeque::new(),
            tracks: vec![Vec::new(); robots],
        }
    }

    /// The same with the frames of RGB-D cameras.
    pub fn filmed(world: World, end: Instant) -> Self {
        Self { is_filmed: true, ..Self::new(world, end) }
    }

    /// Where each robot really was, every twentieth of a second from the first moment on.
    pub fn tracks(&self) -> &[Vec<Pose>] {
        &self.tracks
    }

    /// Lets the robots that have a route drive themselves from now on.
    pub fn hand_over(&mut self) {
        for robot in 0..self.world.robots().len() {
            if self.world.robots()[robot].drives() {
                self.world.tell_wheels(robot, 0.0, 0.0);
            }
        }
    }

    /// The world as it is.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Moves the world on. Wheels obey from the first step of the world that begins after they were
    /// told.
    fn advance(&mut self, now: Instant) {
        let begins = |told: Instant| Instant(told.0.next_multiple_of(STEP.0));
        while let Some(&(told, robot, command)) = self.commands.front()
            && begins(told) <= now
        {
            self.world.advance(begins(told));
            let (speed_m_s, turn_rad_s) = driving::wheels(command);
            self.world.tell_wheels(robot, speed_m_s, turn_rad_s);
            self.commands.pop_front();
        }
        self.world.advance(now);
    }

    fn follow_tracks(&mut self, now: Instant) {
        if self.next_track <= now {
            self.next_track = self.next_track + TRACK_INTERVAL;
            let robots = self.tracks.iter_mut().zip(self.world.robots());
            robots.for_each(|(track, robot)| track.push(robot.truth()));
        }
    }

    fn read_wheels(&mut self, now: Instant) {
        let robots = self.next_odometry.iter_mut().zip(self.world.robots()).enumerate();
        for (robot, (next, simulated)) in robots {
            if *next <= now {
                *next = *next + ODOMETRY_INTERVAL;
                self.waiting.push_back(Event::Odometry { robot, pose: simulated.odometry() });
            }
        }
    }
}

impl Stage for Room {
    fn next_event(&self) -> Option<Instant> {
        if !self.waiting.is_empty() {
            return Some(self.world.now());
        }
        let arrival = if self.is_filmed {
            FrameSource::next_arrival(&self.world)
        } else {
            Source::next_arrival(&self.world)
        };
        let events = [Some(self.next_track), self.world.next_scan(), arrival];
        let odometry = self.next_odometry.iter().copied();
        events.into_iter().flatten().chain(odometry).min().filter(|&next| next <= self.end)
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        if let Some(event) = self.waiting.pop_front() {
            return Some(event);
        }
        self.advance(now);
        self.follow_tracks(now);
        self.read_wheels(now);
        while let Some(scan) = self.world.poll_scan(now) {
            self.waiting.push_back(Event::Scan { robot: scan.robot, readings: scan.readings_mm });
        }
        if self.is_filmed {
            while let Some(frame) = FrameSource::poll(&mut self.world, now) {
                self.waiting.push_back(Event::Frame(frame));
            }
        }
        while let Some(observation) = Source::poll(&mut self.world, now) {
            if !self.is_filmed {
                self.waiting.push_back(Event::Observation(observation));
            }
        }
        self.waiting.pop_front()
    }

    fn drive(&mut self, moment: Instant, robot: usize, command: DriveCommand) {
        self.commands.push_back((moment, robot, command));
    }
}
