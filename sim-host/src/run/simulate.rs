//! `ubimap simulate`: robots in a simulated room.

use std::{
    collections::{BTreeMap, VecDeque},
    path::Path,
    time,
};

use ubimap_agent::{Config, sense::SensorModel};
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, Tile, TileId},
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose},
};

use super::{
    Outcome, RunError, figures,
    fleet::{AgentMemory, Event, FUSED_TILES, Fleet, OWN_TILES, Stage},
    options::SimulateOptions,
    progress::Progress,
};
use crate::{
    camera::Source,
    grid::{self, OccupancyGrid},
    report::{Marker, MarkerKind, PoseErrors, TruthScores},
    server::Footprint,
    world::{Scenario, SimRobot, Truth, WallGrid, World},
};

/// The side of the map's cells.
pub const RESOLUTION: Millimetres = Millimetres(50);
/// Between two readings of the wheels.
const ODOMETRY_INTERVAL: Duration = Duration::from_millis(50);
/// The robots boot at the first moment, and drive from it on. The errors of their poses are
/// counted once they have had the time to meet the server.
const SETTLED: Duration = Duration::from_secs(5);

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
    let mut memory: Vec<AgentMemory> = world
        .robots()
        .iter()
        .zip(&configs)
        .map(|(robot, config)| {
            AgentMemory::new(config, robot.sensor().beams(), own_tiles, FUSED_TILES)
        })
        .collect();
    let faults = options.run.channel.faults();
    let keeper = options.run.keeper(RESOLUTION)?;
    let mut fleet =
        Fleet::new(&configs, &mut memory, faults, RESOLUTION, options.run.seed, keeper)?;

    for robot in world.robots() {
        let half = (robot.radius_m() * 1000.0).round() as u16;
        let footprint = Footprint { half_length: half, half_width: half };
        fleet.set_footprint(robot.id(), footprint);
    }

    let duration = options
        .duration
        .unwrap_or(Duration::from_micros((scenario.duration_s * 1e6).round() as u64));
    let mut stage = Room::new(world, Instant(0) + duration);
    let progress = Progress::new(stage.end, options.run.json);
    let converged = fleet.run(&mut stage, |fleet| progress.at(Instant(0) + fleet.elapsed()))?;
    progress.finish();

    let fused = fleet.server().fused();
    let tiles = fused.tiles().map(|(id, _, tile)| (id, tile));
    let map = OccupancyGrid::from_tiles(tiles, RESOLUTION)?;
    let mut report = figures::report(&fleet, &map, options.run.seed, converged, own_tiles);
    report.truth = Some(score(&map, stage.world.truth())?);
    report.pose = Some(pose_errors(&fleet, &stage.tracks));
    report.simulated_s = fleet.elapsed().micros() as f64 / 1e6;
    report.elapsed_s = started.elapsed().as_secs_f64();
    let mut markers = figures::markers(&fleet);
    markers.extend(stage.world.people().iter().map(|person| {
        let [x_m, y_m] = person.position_m();
        Marker { kind: MarkerKind::Person, x_m, y_m, heading_rad: 0.0, path: Vec::new() }
    }));
    Ok(Outcome { report, map, markers })
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
    /// Where each robot really was, every [`ODOMETRY_INTERVAL`].
    tracks: Vec<Vec<Pose>>,
}

impl Room {
    /// The events of a world until some moment.
    pub fn new(world: World, end: Instant) -> Self {
        let tracks = vec![Vec::new(); world.robots().len()];
        Self { world, end, next_odometry: Instant(0), waiting: VecDeque::new(), tracks }
    }

    fn read_wheels(&mut self) {
        for (index, robot) in self.world.robots().iter().enumerate() {
            self.tracks[index].push(robot.truth());
            self.waiting.push_back(Event::Odometry { robot: index, pose: robot.odometry() });
        }
    }
}

impl Stage for Room {
    fn next_event(&self) -> Option<Instant> {
        if !self.waiting.is_empty() {
            return Some(self.world.now());
        }
        let events = [Some(self.next_odometry), self.world.next_scan(), self.world.next_arrival()];
        events.into_iter().flatten().min().filter(|&next| next <= self.end)
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        if let Some(event) = self.waiting.pop_front() {
            return Some(event);
        }
        self.world.advance(now);
        if self.next_odometry <= now {
            self.next_odometry = self.next_odometry + ODOMETRY_INTERVAL;
            self.read_wheels();
        }
        while let Some(scan) = self.world.poll_scan(now) {
            // The wheels are read with each scan as well.
            let robot = scan.robot;
            self.waiting.push_back(Event::Odometry { robot, pose: scan.odometry });
            self.waiting.push_back(Event::Scan { robot, readings: scan.readings_mm });
        }
        while let Some(observation) = Source::poll(&mut self.world, now) {
            self.waiting.push_back(Event::Observation(observation));
        }
        self.waiting.pop_front()
    }
}

/// How far the robots' poses are from the truth.
fn pose_errors(fleet: &Fleet<'_>, tracks: &[Vec<Pose>]) -> PoseErrors {
    let mut squares = (0.0, 0.0);
    let mut count = 0.0;
    for (robot, track) in fleet.robots().iter().zip(tracks) {
        let path = robot.path().iter();
        let path =
            path.map(|&(moment, pose)| (Instant(moment.since(fleet.began()).micros()), pose));
        for (moment, pose) in path.filter(|(moment, _)| moment.0 >= SETTLED.0) {
            let Some(truth) = true_pose(track, moment) else { continue };
            let (dx, dy) = (pose.x - truth.x, pose.y - truth.y);
            squares.0 += dx.metres().powi(2) + dy.metres().powi(2);
            squares.1 += (pose.heading - truth.heading).degrees().powi(2);
            count += 1.0;
        }
    }
    let root = |sum: f64| if count > 0.0 { (sum / count).sqrt() } else { 0.0 };
    PoseErrors { rmse_m: root(squares.0), rmse_deg: root(squares.1) }
}

/// A robot's pose between two entries of its track.
fn true_pose(track: &[Pose], moment: Instant) -> Option<Pose> {
    let interval = ODOMETRY_INTERVAL.micros();
    let index = (moment.micros() / interval) as usize;
    let (from, to) = (*track.get(index)?, *track.get(index + 1)?);
    let part = (moment.micros() % interval) as f64 / interval as f64;
    let mix = |from: Millimetres, to: Millimetres| {
        Millimetres::from_metres(from.metres() + (to - from).metres() * part)
    };
    let turn = Angle::from_radians((to.heading - from.heading).radians() * part);
    Some(Pose { x: mix(from.x, to.x), y: mix(from.y, to.y), heading: from.heading + turn })
}

/// The map against the truth.
pub fn score(map: &OccupancyGrid, truth: &Truth) -> Result<TruthScores, RunError> {
    let cells = || {
        let surfaces = truth.surfaces.iter().map(|&cell| (cell, Cell::Occupied));
        surfaces.chain(truth.free.iter().map(|&cell| (cell, Cell::Free)))
    };
    let mut tiles = BTreeMap::<TileId, Tile>::new();
    for ((x, y), cell) in cells() {
        let Some(id) = TileId::of_cell(x, y) else { continue };
        let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
        tiles.entry(id).or_default().set(within(x), within(y), cell);
    }
    let reference =
        OccupancyGrid::from_tiles(tiles.iter().map(|(&id, tile)| (id, tile)), RESOLUTION)?;
    let scores = grid::compare(map, &reference, None);
    Ok(TruthScores {
        f1_occupied: scores.f1,
        agreement_known: scores.agreement_known,
        coverage: scores.known_in_both as f64 / (cells().count() as f64).max(1.0),
    })
}
