//! A robot whose only sensor is a grey camera: from images of a floor to tiles (Ahmed 2.1, 2.3).

use std::num::NonZero;

use nalgebra::Point2;
use ubimap_agent::{
    Bounds, Config, Memory, Robot,
    locate::PoseSource,
    sense::{
        COLUMNS, FloorConfig, GroundClearance, ScaleCurve, SensorModel, boundary_point,
        floor_distances, floor_readings,
    },
};
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, TileId},
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};
use ubimap_sim_host::{
    channel::fault::Faults,
    run::fleet::{Event, Fleet, Stage},
    run::heap::{BOUNDS, Heap},
};
use ubimap_tests::{
    deployments::bare,
    floor_view::{FloorView, Spoils},
};

const VIEW: FloorView = FloorView::USUAL;
/// Grey level of the objects unless stated otherwise; the floor's is 140.
const OBJECT: u8 = 70;
const CLEAN: Spoils = Spoils { noise: 0, gradient: 0.0, tiles: 0.0, seed: 1 };

fn distances(image: &[u8]) -> [u8; COLUMNS] {
    floor_distances(image, FloorConfig::default()).unwrap()
}

/// The errors of the distances in lines, for each column. Columns next to an edge are excluded,
/// because the median may use the distance of the next object there.
fn errors(found: &[u8; COLUMNS], depth: impl Fn(usize) -> f64) -> Vec<f64> {
    let limit = f64::from(FloorConfig::default().lines);
    let lines: Vec<_> = (0..COLUMNS).map(|column| VIEW.lines(depth(column)).min(limit)).collect();
    let inside = (2..COLUMNS - 2).filter(|&column| {
        let around = &lines[column - 2..=column + 2];
        around.iter().all(|other| (other - lines[column]).abs() < 3.0)
    });
    inside.map(|column| (f64::from(found[column]) - lines[column]).abs()).collect()
}

/// A slanted wall, a box in front of it, and a post.
fn scene(column: usize) -> f64 {
    match column {
        60..100 => 420.0,
        230..238 => 600.0,
        _ => 900.0 / (1.0 + 0.3 * VIEW.left(column)),
    }
}

#[test]
fn clean_images_are_measured_to_a_line() {
    for object in [20, 90, 190, 250] {
        let found = distances(&VIEW.render(object, scene, CLEAN));
        let errors = errors(&found, scene);
        assert!(errors.len() > 290);
        let worst = errors.into_iter().fold(0.0, f64::max);
        assert!(worst <= 1.0, "grey {object}: {worst}");
    }
}

#[test]
fn noise_tiles_and_light_from_one_side_move_no_boundary() {
    for (noise, gradient, tiles) in
        [(8, 0.0, 0.0), (0, 60.0, 0.0), (0, -60.0, 0.0), (0, 0.0, 12.0), (6, 40.0, 8.0)]
    {
        for seed in 0..5 {
            let spoils = Spoils { noise, gradient, tiles, seed };
            let found = distances(&VIEW.render(OBJECT, scene, spoils));
            let errors = errors(&found, scene);
            let off = errors.iter().filter(|&&error| error > 1.0).count();
            println!("{spoils:?}: {off} off, worst {}", errors.iter().copied().fold(0.0, f64::max));
            assert!(off * 100 <= errors.len(), "{spoils:?}: {off} of {}", errors.len());
        }
    }
}

/// A calibration as a user would do it: places an object at several distances, and fits the table.
fn calibrated() -> ScaleCurve {
    let mut table: Vec<(u8, f32)> = Vec::new();
    for depth in (290..1_060).step_by(15) {
        let pixels = distances(&VIEW.render(OBJECT, |_| f64::from(depth), CLEAN))[COLUMNS / 2];
        // The first distance for each number of pixels, from the near to the far end of table 1.
        let new = table.last().is_none_or(|&(last, _)| last < pixels);
        if new && (62..=121).contains(&pixels) {
            table.push((pixels, depth as f32));
        }
    }
    ScaleCurve::fit(&table).unwrap()
}

#[test]
fn a_fitted_curve_is_accurate_to_a_pixel() {
    let curve = calibrated();
    for pixels in 65..=118u8 {
        let depth = VIEW.focal * VIEW.height / (VIEW.horizon - f64::from(pixels));
        let off = f64::from(curve.distance(pixels).unwrap()) - depth;
        let reach = f64::from(curve.reach(pixels).unwrap());
        assert!(off.abs() <= reach, "{pixels} pixels: {depth} mm, off by {off}, reach {reach}");
    }
}

#[test]
fn the_ground_is_clear_before_a_wall_and_not_before_a_near_box() {
    let clear = |near: f64| {
        let depth = |column| if (150..170).contains(&column) { near } else { 700.0 };
        let spoils = Spoils { noise: 6, ..CLEAN };
        GroundClearance::default().is_clear(&distances(&VIEW.render(OBJECT, depth, spoils)))
    };
    assert!(clear(700.0));
    assert!(!clear(250.0));
}

/// Half the size of the room along x and along y, in millimetres.
const ROOM: (f64, f64) = (700.0, 600.0);

/// Where the ray of a column meets the wall: its depth, and the point.
fn wall(pose: Pose, left: f64) -> (f64, (f64, f64)) {
    let (sin, cos) = pose.heading.radians().sin_cos();
    let (dx, dy) = (cos - left * sin, sin + left * cos);
    let (x, y) = (pose.x.metres() * 1e3, pose.y.metres() * 1e3);
    let to = |from: f64, step: f64, half: f64| ((half * step.signum() - from) / step).abs();
    let depth = to(x, dx, ROOM.0).min(to(y, dy, ROOM.1));
    (depth, (x + depth * dx, y + depth * dy))
}

/// Distance of a point from the nearest wall.
fn from_wall(x: f64, y: f64) -> f64 {
    let outside = (x.abs() - ROOM.0, y.abs() - ROOM.1);
    match outside.0.max(outside.1) <= 0.0 {
        true => outside.0.max(outside.1).abs(),
        false => outside.0.max(0.0).hypot(outside.1.max(0.0)),
    }
}

/// Twelve directions at each of four places.
fn poses() -> impl Iterator<Item = Pose> {
    let at = |index: i32| {
        let heading = f64::from(index / 4).mul_add(30.0, 7.0).to_radians();
        let along = f64::from(index % 4) * 0.05 - 0.1;
        Pose::from_metres(along * heading.cos() + 0.03, along * heading.sin() - 0.02, heading)
    };
    (0..48).map(at)
}

fn look(pose: Pose, seed: u64) -> [u8; COLUMNS] {
    let spoils = Spoils { noise: 6, gradient: 20.0, tiles: 6.0, seed };
    distances(&VIEW.render(OBJECT, |column| wall(pose, VIEW.left(column)).0, spoils))
}

#[test]
fn boundaries_lie_on_the_walls_whichever_way_the_robot_looks() {
    let curve = calibrated();
    let (mut found, mut off, mut off_as_ranges) = (0, 0, 0);
    for (seed, pose) in poses().enumerate() {
        let readings = floor_readings(&look(pose, seed as u64), &curve);
        let robot = Point2::new(pose.x.0 as f32, pose.y.0 as f32);
        for (column, &reading) in readings.iter().enumerate().filter(|(_, reading)| **reading > 0) {
            let left = VIEW.left(column);
            let (depth, (x, y)) = wall(pose, left);
            let bearing = (pose.heading.radians() + left.atan()) as f32;
            let towards = Point2::new(robot.x + bearing.cos(), robot.y + bearing.sin());
            let distance = f64::from(reading) * left.hypot(1.0);
            let error = |distance: f64| {
                let point = boundary_point(robot, towards, distance as f32).unwrap();
                (f64::from(point.x) - x).hypot(f64::from(point.y) - y)
            };
            // The distance error that one and a half pixels cause at this depth.
            let bound = 1.5 * depth * depth / (VIEW.focal * VIEW.height) * left.hypot(1.0);
            found += 1;
            off += u32::from(error(distance) > bound);
            // The error with the paper's geometry.
            off_as_ranges += u32::from(error(reading.into()) > bound);
        }
    }
    println!("{found} boundaries, {off} off; {off_as_ranges} off if depths are taken for ranges");
    assert!(found > 10_000, "{found}");
    assert!(off * 100 <= found, "{off} of {found}");
    assert!(off_as_ranges * 2 > found, "{off_as_ranges} of {found}");
}

/// Whether an object is still in the map after it was first seen in front of the robot, and then
/// seen through as often from a little further away.
fn stays(depth: f64, near: Option<NonZero<u16>>) -> bool {
    let model = SensorModel::Pinhole { focal: VIEW.focal as f32, centre: 159.5 };
    let pose_source = PoseSource::Odometry(Pose::default());
    let bounds = Bounds { readings: COLUMNS, own_tiles: 8, fused_tiles: 4, ..BOUNDS };
    let config = Config { pose_source, near, ..Config::new(RobotId(1), model, bounds) };
    let mut memory = Memory::<Heap>::new(&bounds);
    let mut robot = Robot::new(config, &mut memory).unwrap();
    let curve = calibrated();
    for (count, depth) in (1..).zip([depth, 1_000.0, 1_000.0]) {
        let now = Instant(0) + Duration::from_secs(count);
        let pose = Pose::from_metres(0.0, 0.04 * count as f64, 0.0);
        robot.odometry(now, pose, now);
        let image = VIEW.render(OBJECT, |_| depth, CLEAN);
        robot.scan(now, &floor_readings(&distances(&image), &curve), now).unwrap();
    }
    assert_eq!(robot.statistics().mapped, 3);
    let (x, y) = ((depth / 50.0) as i32, 1);
    let id = TileId { x: (x / 32) as i16, y: 0 };
    let tile = robot.own_tiles().tiles().find(|tile| tile.id() == Some(id)).unwrap();
    tile.cells().cell(x as usize % 32, y as usize) == Cell::Occupied
}

#[test]
fn distant_hits_are_given_up_sooner_than_near_ones() {
    // For this camera the size of a pixel grows with the square of the distance. So the weight
    // falls to one half at 1.4 times the minimum distance of 24,000 / (144 - 62) mm, which is 414
    // mm. The slope of a fit is less certain at its ends.
    let near = calibrated().near();
    assert!((near - 414.0).abs() < 50.0, "{near}");
    let near = NonZero::new(near as u16);
    assert!(stays(320.0, near), "near");
    assert!(!stays(620.0, near), "far");
    // A quarter of the range would not do as a limit: with a range of 4 m it is more than this
    // camera can see.
    assert!(stays(320.0, None) && stays(620.0, None));
}

/// The robot's odometry and scans in order.
struct Script {
    events: Vec<(Instant, Event)>,
}

impl Stage for Script {
    fn next_event(&self) -> Option<Instant> {
        self.events.first().map(|(moment, _)| *moment)
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        self.next_event().filter(|next| *next <= now)?;
        Some(self.events.remove(0).1)
    }
}

#[test]
fn a_robot_with_a_grey_camera_alone_maps_the_walls_of_its_room() {
    let curve = calibrated();
    let mut events = Vec::new();
    for (index, pose) in poses().enumerate() {
        let moment = Instant(0) + Duration::from_secs(5 + index as u64);
        events.push((moment, Event::Odometry { robot: 0, pose }));
        let readings = floor_readings(&look(pose, index as u64), &curve).to_vec();
        events.push((moment, Event::Scan { robot: 0, readings }));
    }
    // Time for the last tiles to arrive.
    let end = Instant(0) + Duration::from_secs(60);
    events.push((end, Event::Odometry { robot: 0, pose: Pose::default() }));

    let model = SensorModel::Pinhole { focal: VIEW.focal as f32, centre: 159.5 };
    let pose_source = PoseSource::Odometry(Pose::default());
    let near = NonZero::new(curve.near() as u16);
    let bounds = Bounds { readings: COLUMNS, max_range: 2_000, ..BOUNDS };
    let config = Config { pose_source, near, ..Config::new(RobotId(1), model, bounds) };
    let config = config.with_drive(None);
    let mut memory = [Memory::new(&bounds)];
    let mut fleet =
        Fleet::new(&[config], &mut memory, Faults::default(), 1, bare(Millimetres(50))).unwrap();
    fleet.run(&mut Script { events }, |_| {}).unwrap();

    let mut walls = [0; 4];
    let (mut occupied, mut off) = (0, 0);
    for (id, _, tile) in fleet.server().fused().tiles() {
        let (x0, y0) = id.first_cell();
        for (x, y) in (0..TILE_SIDE * TILE_SIDE).map(|cell| (cell % TILE_SIDE, cell / TILE_SIDE)) {
            if matches!(tile.cell(x, y), Cell::Occupied | Cell::Movable) {
                let middle = |first: i32, cell: usize| f64::from(first + cell as i32) * 50.0 + 25.0;
                let (x, y) = (middle(x0, x), middle(y0, y));
                occupied += 1;
                // Within one and a half cells.
                off += u32::from(from_wall(x, y) > 75.0);
                let sides = [ROOM.0 - x, ROOM.0 + x, ROOM.1 - y, ROOM.1 + y];
                for (count, side) in walls.iter_mut().zip(sides) {
                    *count += u32::from(side.abs() <= 75.0);
                }
            }
        }
    }
    println!("{occupied} cells occupied, {off} off, by wall {walls:?}");
    assert!(off * 20 <= occupied, "{off} of {occupied}");
    // The walls are 28 and 24 cells long.
    assert!(walls.iter().all(|&cells| cells >= 20), "{walls:?}");

    // The same scans were sent to the server as distance vectors: the first two dozen once per
    // second.
    let vector = fleet.server().distance_vector(RobotId(1)).unwrap();
    let count = fleet.server().distance_vectors(RobotId(1));
    assert!((24..=32).contains(&count), "{count}");
    let (mut seen, mut wrong) = (0, 0);
    for (column, &units) in vector.distances.iter().enumerate().filter(|(_, units)| **units > 0) {
        let bearing = vector.first.radians() + column as f64 * f64::from(vector.step) * TURN;
        let (depth, _) = wall(vector.pose, bearing.tan());
        let off = f64::from(units) * 20.0 - depth / bearing.cos();
        seen += 1;
        wrong += u32::from(off.abs() > 90.0);
    }
    assert!(seen > 30 && wrong * 10 <= seen, "{wrong} of {seen}");
}

/// A binary angle unit in radians.
const TURN: f64 = std::f64::consts::TAU / 65_536.0;
