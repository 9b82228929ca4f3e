//! `ubimap simulate`: robots in a simulated room.

use std::{collections::VecDeque, path::Path, time};

use ubimap_agent::{Config, drive::DriveCommand, sense::SensorModel};
use ubimap_protocol::{
    tile::Cell,
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

use super::{
    Outcome, RunError,
    driving::{self, BlindGround},
    figures,
    fleet::{AgentMemory, Event, FUSED_TILES, Fleet, OWN_TILES, Stage},
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
    world::{MarkerConfig, RobotConfig, Scenario, SimRobot, WallGrid, World},
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

    let own_tiles = options.run.tiles.map_or(OWN_TILES, |tiles| tiles as usize);
    let configs: Vec<Config> =
        world.robots().iter().map(|robot| config(robot, options.run.seed)).collect();
    let mut memory = memory(&world, &configs, own_tiles);
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
        driving::set_out(&mut fleet, &stage.world, options.motion);
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

/// The configuration of a simulated robot's agent.
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
    Config {
        resolution: RESOLUTION,
        max_range: (sensor.max_range_m() * 1000.0).clamp(0.0, f64::from(u16::MAX)) as u16,
        mounting: sensor.mount(),
        boot_nonce: seed as u32 ^ u32::from(robot.id().0) << 16,
        ..Config::new(robot.id(), model)
    }
}

/// Memory for the agents of a world's robots, with so many tiles of their own.
pub fn memory(world: &World, configs: &[Config], own_tiles: usize) -> Vec<AgentMemory> {
    let robots = world.robots().iter().zip(configs);
    let memory = robots.map(|(robot, config)| {
        AgentMemory::new(config, robot.sensor().beams(), own_tiles, FUSED_TILES)
    });
    memory.collect()
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

/// The simulated room as a source of events.
pub struct Room {
    world: World,
    end: Instant,
    next_odometry: Instant,
    waiting: VecDeque<Event>,
    /// Whether the cameras give frames; what ideal ones see otherwise.
    is_filmed: bool,
    /// Whether robots that have a route drive themselves.
    is_driven: bool,
    /// Where each robot really was, every [`TRACK_INTERVAL`].
    tracks: Vec<Vec<Pose>>,
}

impl Room {
    /// The events of a world until some moment, with ideal cameras: nothing is drawn and nothing
    /// looked at, what is in view is known.
    pub fn new(world: World, end: Instant) -> Self {
        let tracks = vec![Vec::new(); world.robots().len()];
        let (next_odometry, waiting) = (Instant(0), VecDeque::new());
        Self { world, end, next_odometry, waiting, is_filmed: false, is_driven: false, tracks }
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
        self.is_driven = true;
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

    fn read_wheels(&mut self) {
        for (index, robot) in self.world.robots().iter().enumerate() {
            self.tracks[index].push(robot.truth());
            self.waiting.push_back(Event::Odometry { robot: index, pose: robot.odometry() });
            if self.is_driven && robot.drives() {
                self.waiting.push_back(Event::Drive { robot: index });
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
        let events = [Some(self.next_odometry), self.world.next_scan(), arrival];
        events.into_iter().flatten().min().filter(|&next| next <= self.end)
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        if let Some(event) = self.waiting.pop_front() {
            return Some(event);
        }
        self.world.advance(now);
        if self.next_odometry <= now {
            self.next_odometry = self.next_odometry + TRACK_INTERVAL;
            self.read_wheels();
        }
        while let Some(scan) = self.world.poll_scan(now) {
            // The wheels are read with each scan as well.
            let robot = scan.robot;
            self.waiting.push_back(Event::Odometry { robot, pose: scan.odometry });
            self.waiting.push_back(Event::Scan { robot, readings: scan.readings_mm });
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

    fn drive(&mut self, robot: usize, command: DriveCommand) {
        let (speed_m_s, turn_rad_s) = driving::wheels(command);
        self.world.tell_wheels(robot, speed_m_s, turn_rad_s);
    }
}
