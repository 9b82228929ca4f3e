//! `ubimap simulate`: robots in a simulated room.

use std::{path::Path, time};

use image::RgbImage;
use ubimap_agent::{
    Bounds, Config, Memory,
    drive::Driving,
    locate::PoseSource,
    sense::{self, Camera, SensorModel, Validity},
};
use ubimap_protocol::{
    tile::Cell,
    time::{Duration, Instant},
    units::Millimetres,
};

use super::{
    Outcome, RunError,
    body::{BUFFER, CAMERA},
    calibration_drive,
    driving::{self, BlindGround},
    figures,
    fleet::{Bodies, Fleet},
    grey_robot::Sight,
    heap::{BOUNDS, check_tiles},
    labels,
    map_age::MapAge,
    markers, network,
    options::{Knock, MotionName, SensorName, SimulateOptions},
    outside::robot::Outside,
    pointset::Pointset,
    progress::Progress,
    record::{Recorded, Recording},
    rising::Risings,
    room_stage::RoomStage,
    scan_log::ScanLog,
    scoring,
    time_lapse::{self, TimeLapse},
    vision::{Calibrated, Vision},
    volatility,
};
use crate::{
    camera::{Calibration, FrameSource},
    deployment::{
        self, Deployment,
        registry::{RegisteredRobot, Registry},
    },
    grid::{self, OccupancyGrid},
    perception::markers::Hue,
    recording::PixelModel,
    report::{self, Caption, Marker, OutputFile, TrackedPerson},
    server::coordination::{Area, DrivableFloor},
    world::{MarkerConfig, RobotConfig, Scenario, SimRobot, WallGrid, World},
};

/// The side of the map's cells.
pub const RESOLUTION: Millimetres = Millimetres(50);

/// How far beyond what is known of a floor plan robots may go, in metres: so that one that has drifted is not held outside.
const PLAN_MARGIN_M: f64 = 1.0;

/// Runs a scenario.
pub fn run(options: &SimulateOptions) -> Result<Outcome, RunError> {
    let started = time::Instant::now();
    let Furnished { scenario, plan, walls, world } = furnished(options)?;
    let mut options = options.clone();
    // Without fixed cameras the server knows no robot's pose, and leads none.
    options.scripted |= FrameSource::cameras(&world).is_empty();
    let options = &options;
    let calibrated = if options.calibrate {
        let (walls, registry, seed) = (walls.as_ref(), registry(&scenario), !options.run.seed);
        Some(calibration_drive::calibrated(&scenario, walls, RESOLUTION, &registry, seed)?)
    } else {
        None
    };
    let (cameras, calibration_errors) = calibrated.unzip();
    let vision = vision(options, &world)?;
    let sight = vision.as_ref().map(|vision| Sight {
        curve: vision.curve(),
        follows_boundaries: options.motion == MotionName::Boundary,
    });
    let place = options.place();
    let configs = if place.is_some() { Vec::new() } else { robots(options, sight, &world) };
    check_tiles(configs.len(), own_tiles(options))?;
    let points = options.keeps_points(&scenario).then(|| {
        let starts = world.robots().iter().map(SimRobot::truth);
        Pointset::new(configs.iter().copied().zip(starts))
    });
    let mut memory: Vec<_> = configs.iter().map(|it| Memory::new(&it.bounds)).collect();
    let (keeper, life) = options.run.keeper(RESOLUTION)?;
    let mut config = deployed(options, &scenario, &world);
    // Through gaps in its walls, robots would leave a plan, and explore the void.
    config.floor = plan.as_ref().and_then(|plan| {
        let area = Area::around_known(plan, PLAN_MARGIN_M).map_err(|error| error.to_string());
        let floor = area.and_then(|area| {
            let floor = DrivableFloor::new(RESOLUTION, Some(&area), None);
            floor.map_err(|error| format!("it {error}"))
        });
        floor.inspect_err(|error| log::warn!("robots may leave the map: {error}")).ok()
    });
    config.labels = labels::read(options.run.labels.as_deref())?;
    if !options.no_classes {
        config.labels.extend(scenario.labels()?);
    }
    if let Some(cameras) = cameras {
        config.cameras = cameras;
    }
    let mut deployment = Deployment::new(config, life)?;
    for robot in world.robots().iter().filter(|robot| robot.drives() && options.is_led()) {
        deployment.explore(robot.id(), true);
    }
    let mut buffers = vec![[0; BUFFER]; if options.drivers { configs.len() } else { 0 }];
    let bodies = match sight {
        Some(sight) => Bodies::Grey(sight),
        None => Bodies::Machines(&mut buffers),
    };
    let (faults, seed) = (options.run.channel.faults(), options.run.seed);
    let mut fleet = Fleet::of_bodies(&configs, &mut memory, bodies, faults, seed, deployment)?;
    if let Some(keeper) = keeper {
        fleet.keep(keeper);
    }
    if let (Some(place), [robot]) = (&place, world.robots()) {
        fleet.connect(robot.id(), place, seed)?;
    }
    let recording = recording(options, &scenario, &world)?;

    let duration = options
        .duration
        .unwrap_or(Duration::from_micros((scenario.duration_s * 1e6).round() as u64));
    let end = Instant(0) + duration;
    let ground = BlindGround::of(&world, plan.as_ref(), RESOLUTION);
    let map_age = MapAge::of(&scenario, walls.as_ref(), RESOLUTION)?;
    let risings = Risings::of(&scenario, &world, RESOLUTION.metres());
    let mut stage = if options.ideal_cameras {
        RoomStage::new(world, end)
    } else {
        RoomStage::filmed(world, end)
    };
    if !options.scripted {
        stage.hand_over();
    }
    if let Some(vision) = vision {
        stage.keep_vision(vision);
    }
    if options.baselines {
        stage.keep_onboard();
    }
    if let Some(points) = points {
        stage.keep_points(points, options.exposure);
    }
    if let Some(path) = &options.log {
        stage.keep_log(ScanLog::create(path, stage.world().robots())?);
    }
    let progress = Progress::new(end);
    let mut time_lapse = TimeLapse::new(duration);
    let mut stage = Recorded { stage, recording };
    fleet.play(&mut stage, |fleet| {
        progress.at(fleet.now());
        ground.look(fleet);
        map_age.look(fleet);
        risings.look(fleet);
        time_lapse.look(fleet);
    })?;
    time_lapse.end(&fleet);
    let seen = Seen::by(&fleet, stage.stage.world(), options)?;
    let converged = fleet.settle(&mut stage)?;
    drop(progress);
    let mut stage = stage.finish()?;
    stage.finish_log()?;

    let map = time_lapse::grid(&fleet)?;
    let mut report = figures::report(&fleet, &map, options.run.seed, converged, own_tiles(options));
    report.truth = Some(scoring::score(&map, stage.world())?);
    report.calibration = calibration_errors;
    report.camera_moves = figures::camera_moves(fleet.deployment());
    report.unexplored = figures::unexplored(fleet.deployment());
    report.pose = Some(scoring::pose_errors(&fleet, stage.tracks()));
    let sighted = scoring::sighting_errors(&fleet, stage.tracks());
    report.sighted = (!options.ideal_cameras).then_some(sighted);
    report.driving = Some(ground.summary(&fleet, stage.world(), stage.tracks()));
    report.vision = stage.vision().map(Vision::summary);
    report.changes = map_age.summary();
    report.risings = risings.summary();
    report.people.clone_from(&seen.people);
    let errors = || scoring::position_errors(&fleet, stage.tracks());
    report.baselines = stage.onboard().map(|onboard| onboard.summary(&errors()));
    report.points = stage.points().map(Pointset::summary);
    let late = fleet.outside().and_then(Outside::late);
    report.late_s = late.map(|late| late.micros() as f64 / 1e6);
    report.drawn_on_standing = scoring::drawn_on_standing(&map, stage.world());
    report.simulated_s = fleet.elapsed().micros() as f64 / 1e6;
    report.elapsed_s = started.elapsed().as_secs_f64();
    let mut pictures = seen.pictures(&map, stage.world(), &time_lapse)?;
    let intervals = volatility::intervals(fleet.deployment(), &map, fleet.now());
    pictures.push(("volatility.png", report::render_volatility(&map, &intervals, &seen.caption)));
    pictures.extend(stage.vision().and_then(Vision::picture).map(|it| ("robot-view.png", it)));
    if let Some(points) = stage.points() {
        pictures.push(("points.png", points.picture(stage.world(), RESOLUTION.metres())));
        if let Some(path) = &options.points {
            OutputFile::create(path)?.finish(points.table().as_bytes())?;
        }
    }
    let Seen { markers, caption, .. } = seen;
    let cameras = world_cameras(fleet.deployment(), stage.world()).map(|(camera, _)| camera);
    let drawing = network::svg(&map, &scenario, stage.world(), cameras);
    let tables = vec![("network.svg", drawing)];
    Ok(Outcome { report, map, markers, caption, pictures, tables })
}

/// The requested scenario, its map and the map's walls, if it has one, and its world.
struct Furnished {
    scenario: Scenario,
    plan: Option<OccupancyGrid>,
    walls: Option<WallGrid>,
    world: World,
}

fn furnished(options: &SimulateOptions) -> Result<Furnished, RunError> {
    let mut scenario = Scenario::read_with(&options.scenario, options.map.as_deref())?;
    let plan = scenario.room.map.as_deref().map(straight_map).transpose()?;
    let walls = plan.as_ref().map(wall_grid);
    if let (Some(plan), Some(walls)) = (&plan, &walls) {
        log::info!("{}", read_of(&scenario, plan));
        // What grows can be any number of robots.
        if let (Some(grow), Some(robots)) = (&mut scenario.grow, options.robots) {
            grow.robots = robots.try_into().unwrap_or(u8::MAX);
        }
        let free: Vec<bool> = plan.cells().iter().map(|&cell| cell == Cell::Free).collect();
        scenario.grow_in(walls, &free)?;
    }
    if let Some(robots) = options.robots {
        let asked = usize::from(robots);
        if asked > scenario.robots.len() {
            return Err(RunError::TooManyRobots { asked, there: scenario.robots.len() });
        }
        scenario.robots.truncate(asked);
    }
    for &Knock { camera, knock } in &options.knock {
        let there = scenario.cameras.len();
        let config = scenario.cameras.get_mut(camera);
        config.ok_or(RunError::NoSuchCamera { camera, there })?.knocks.push(knock);
    }
    for camera in &mut scenario.cameras {
        camera.knocks.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
    }
    let there = scenario.robots.len();
    if options.place().is_some() && there != 1 {
        return Err(RunError::OneRobot { there });
    }
    if options.place().is_some() && scenario.cameras.is_empty() {
        return Err(RunError::NoCameraForOutside);
    }
    for robot in &mut scenario.robots {
        robot.identifier_askew_deg += options.identifier_askew;
    }
    if options.sensor == SensorName::GreyCamera {
        for robot in &mut scenario.robots {
            robot.sensor = robot.sensor.to_grey_camera(robot.height_m);
        }
    }
    if options.place().is_some() || options.drivers {
        for robot in &mut scenario.robots {
            *robot = robot.on_create2(CAMERA.binning.side());
        }
    }
    let world = World::new(&scenario, walls.as_ref(), RESOLUTION, options.run.seed)?;
    Ok(Furnished { scenario, plan, walls, world })
}

/// The accuracy of the robots' grey cameras, which are calibrated before the run; `None` without them.
fn vision(options: &SimulateOptions, world: &World) -> Result<Option<Vision>, RunError> {
    let sensor = world.robots().iter().map(SimRobot::sensor).find(|sensor| sensor.sees_grey());
    if sensor.is_none() && options.motion == MotionName::Boundary {
        return Err(RunError::BoundaryNeedsPictures);
    }
    let vision = |sensor| Ok(Vision::new(Calibrated::of(sensor, options.run.seed)?, sensor));
    sensor.map(vision).transpose()
}

/// Number of own tiles per robot.
fn own_tiles(options: &SimulateOptions) -> usize {
    options.run.tiles.map_or(BOUNDS.own_tiles, |tiles| tiles as usize)
}

/// The configurations of a world's robots. They drive themselves unless the run is scripted.
fn robots(
    options: &SimulateOptions,
    sight: Option<Sight>,
    world: &World,
) -> Vec<Config<Option<Driving>>> {
    let robots = world.robots().iter().map(|robot| {
        let driving = driving::driving(robot, options.motion).filter(|_| options.is_led());
        let mut config = config(robot, options.run.seed).with_drive(driving);
        if let Some(sight) = sight {
            config = sight.configured(config);
        }
        config.peer_mask = options.peer_mask.into();
        config.policy = options.selection.policy.into();
        config.gate = options.selection.gate();
        if options.pixel_model == PixelModel::Linear {
            config.sensor = linear(config.sensor, robot);
        }
        if FrameSource::cameras(world).is_empty() {
            config.pose_source = PoseSource::Odometry(robot.truth());
        }
        config.bounds.own_tiles = own_tiles(options);
        config
    });
    robots.collect()
}

/// A camera whose columns are taken to have equal angles (Aluckal, equation 2); other sensors as they are.
fn linear(sensor: SensorModel, robot: &SimRobot) -> SensorModel {
    let SensorModel::Pinhole { focal, centre } = sensor else { return sensor };
    let field = -2.0 * robot.sensor().first_angle_rad() as f32;
    let pixels = sense::PixelModel::LinearAngle { field };
    let camera = Camera { pixels, ..Camera::new((focal, focal), (centre, 0.0)) };
    SensorModel::Row { camera, row: 0.0 }
}

/// The deployment of a scenario. Ideal cameras deliver observations instead of frames.
fn deployed(options: &SimulateOptions, scenario: &Scenario, world: &World) -> deployment::Config {
    let coordination = options.is_led().then(|| driving::coordination(world));
    let is_filmed = !options.ideal_cameras;
    deployment::Config {
        coordination,
        keeps_sightings: is_filmed,
        ..deployment_config(scenario, world, is_filmed)
    }
}

/// A deployment with the robots of a scenario, with its cameras if `is_filmed`, and without a
/// coordinator.
pub fn deployment_config(
    scenario: &Scenario,
    world: &World,
    is_filmed: bool,
) -> deployment::Config {
    let cameras = if is_filmed { FrameSource::cameras(world).to_vec() } else { Vec::new() };
    let registry = registry(scenario);
    deployment::Config { cameras, registry, ..deployment::Config::new(RESOLUTION) }
}

/// The recording of the camera frames, if requested.
fn recording(
    options: &SimulateOptions,
    scenario: &Scenario,
    world: &World,
) -> Result<Option<Recording>, RunError> {
    let create =
        |folder| Recording::create(folder, FrameSource::cameras(world), &registry(scenario));
    options.record.as_deref().map(create).transpose()
}

/// The state after the last frame. It is taken before the maps converge, because no frames arrive
/// in that phase and the observations go stale.
struct Seen {
    coverage: OccupancyGrid,
    cameras: Vec<Marker>,
    markers: Vec<Marker>,
    people: Vec<TrackedPerson>,
    caption: Caption,
}

impl Seen {
    fn by(fleet: &Fleet<'_>, world: &World, options: &SimulateOptions) -> Result<Self, RunError> {
        let deployment = fleet.deployment();
        let tiles = deployment.server().coverage().tiles().map(|(id, _, tile)| (id, tile));
        let cameras = markers::cameras(world_cameras(deployment, world));
        let mut markers = markers::robots(fleet);
        markers.extend(markers::people(deployment, fleet.now()));
        markers.extend(cameras.iter().cloned());
        let name = options.scenario.file_stem().unwrap_or_default();
        Ok(Self {
            coverage: OccupancyGrid::from_tiles(tiles, RESOLUTION)?,
            cameras,
            markers,
            people: markers::tracked_people(deployment, fleet.now()),
            caption: Caption {
                subject: name.to_string_lossy().into_owned(),
                seed: Some(options.run.seed),
                time_s: Some(fleet.elapsed().micros() as f64 / 1e6),
            },
        })
    }

    fn pictures(
        &self,
        map: &OccupancyGrid,
        world: &World,
        time_lapse: &TimeLapse,
    ) -> Result<Vec<(&'static str, RgbImage)>, RunError> {
        let Self { coverage, cameras, caption, .. } = self;
        Ok(vec![
            ("coverage.png", report::render_coverage(map, coverage, cameras, caption)),
            ("error.png", scoring::error_picture(map, world, caption)?),
            ("timelapse.png", time_lapse.picture(map, caption)),
        ])
    }
}

/// The cameras where the server knows them, and whether they are in use; those of the world if the
/// server has none.
fn world_cameras<'a>(
    deployment: &'a Deployment,
    world: &'a World,
) -> Box<dyn Iterator<Item = (&'a Calibration, bool)> + 'a> {
    if deployment.calibrations().next().is_some() {
        Box::new(deployment.calibrations())
    } else {
        Box::new(FrameSource::cameras(world).iter().map(|camera| (camera, true)))
    }
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
    // The cast saturates.
    let millimetres = |metres: f64| (metres * 1000.0) as u16;
    let bounds = Bounds {
        readings: sensor.beams(),
        resolution: RESOLUTION,
        max_range: millimetres(sensor.max_range_m()),
        ..BOUNDS
    };
    Config {
        mounting: sensor.mount(),
        boot_nonce: seed as u32 ^ u32::from(robot.id().0) << 16,
        validity: Validity { clear: millimetres(sensor.clear_m()), ..Validity::of(model) },
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
    let diameter_m = box_m.is_none().then_some(2.0 * radius_m);
    let sides = box_m.unwrap_or([2.0 * radius_m; 2]);
    let usual = RegisteredRobot::new(id, marker_size_m, height_m, sides);
    RegisteredRobot { tag_id, colours, box_m, diameter_m, ..usual }
}

/// Reads a ROS map that must have a yaw of 0.
fn straight_map(yaml: &Path) -> Result<OccupancyGrid, RunError> {
    let map = grid::read_map(yaml)?;
    if map.yaw_rad() != 0.0 {
        return Err(RunError::TurnedMap { path: yaml.to_owned(), yaw_rad: map.yaw_rad() });
    }
    Ok(map)
}

/// What was read of a scenario's map, so that somebody sees whether it was read as it was meant.
fn read_of(scenario: &Scenario, map: &OccupancyGrid) -> String {
    let counts = map.counts();
    let cell_m2 = map.resolution_m().powi(2);
    let metres = |cells: usize| cells as f64 * map.resolution_m();
    let area = |cells: usize| cells as f64 * cell_m2;
    let unknown = map.cells().len() - counts.free - counts.occupied;
    format!(
        "{}: {:.1} x {:.1} m in cells of {:.3} m: {} cells of walls, {:.0} m2 free, {:.0} m2 unknown",
        scenario.room.map.as_deref().unwrap_or(Path::new("map")).display(),
        metres(map.width()),
        metres(map.height()),
        map.resolution_m(),
        counts.occupied,
        area(counts.free),
        area(unknown),
    )
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
