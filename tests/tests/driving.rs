//! Autonomous robots coordinated by the server map the blind ground without collisions, even while
//! links are cut. `cargo driving` prints the tables over ten seeds.

use std::{env, fs, path::Path};

use clap::Parser;
use ubimap_agent::{
    Config, Memory, Robot,
    drive::{Driving, Motion, Reason},
    locate::PoseSource,
};
use ubimap_protocol::{
    frame::DEFAULT_FRAME,
    message::Waypoint,
    tile::{Cell, TileId},
    time::{Duration, Instant},
    units::Pose,
};
use ubimap_sim_host::{
    run::{
        Outcome,
        heap::Heap,
        options::SimulateOptions,
        simulate::{self, RESOLUTION},
    },
    world::{Contacts, Scenario, World},
};
use ubimap_tests::{
    routes::{SETS, scripted},
    seeds::seeds,
};

/// Two rooms with a door; the camera sees the first of them, where a person walks.
const TWO_ROOMS: &str = r#"
    duration_s = 240.0
    slice_height_m = 0.2

    [room]
    height_m = 3.0
    outline_m = [[0.0, 0.0], [7.0, 0.0], [7.0, 4.0], [0.0, 4.0]]
    [[room.walls]]
    points_m = [[3.5, 0.0], [3.5, 1.4]]
    [[room.walls]]
    points_m = [[3.5, 2.6], [3.5, 4.0]]

    [[furniture]]
    footprint.box = { centre_m = [5.4, 2.0], size_m = [0.8, 0.6] }
    top_m = 1.5

    [[cameras]]
    position_m = [0.3, 2.0, 2.8]
    look_at_m = [1.6, 2.0, 0.0]
    range_m = 4.5

    [[robots]]
    id = 1
    start = { x_m = 1.0, y_m = 1.2, heading_deg = 0.0 }
    route.waypoints_m = [[1.5, 1.2]]

    [[robots]]
    id = 2
    start = { x_m = 1.0, y_m = 2.8, heading_deg = 0.0 }
    route.waypoints_m = [[1.5, 2.8]]

    [[people]]
    waypoints_m = [[2.2, 0.6], [2.2, 3.4]]
    pause_s = 4.0
"#;

#[derive(Parser)]
struct CommandLine {
    #[command(flatten)]
    options: SimulateOptions,
}

/// Runs a scenario, from a file or built in, with command-line options.
fn simulated(scenario: &str, options: &[&str]) -> Outcome {
    let fixed = ["simulate", scenario, "--json"];
    let command_line = CommandLine::parse_from(fixed.iter().chain(options));
    simulate::run(&command_line.options).unwrap()
}

/// Writes a scenario to a file and returns its path.
fn written(name: &str, scenario: &str) -> String {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    fs::write(&path, scenario).unwrap();
    path.to_str().unwrap().into()
}

/// Runs a scenario for the tables: with ideal cameras, unless `UBIMAP_CAMERAS` is `filmed`.
fn run(scenario: &str, seed: u64, options: &[&str]) -> Outcome {
    let is_filmed = env::var("UBIMAP_CAMERAS").is_ok_and(|cameras| cameras == "filmed");
    let cameras: &[&str] = if is_filmed { &[] } else { &["--ideal-cameras"] };
    let seed = seed.to_string();
    let outcome = simulated(scenario, &[&["--seed", &seed], cameras, options].concat());
    let driving = outcome.report.driving.unwrap();
    assert_eq!(driving.collisions, 0, "{}", outcome.report);
    // In 2 of 46 runs of `room` a robot that moved touched somebody who came near: README.md.
    assert!(driving.touches <= 1, "{}", outcome.report);
    outcome
}

/// Time until 99 % of the blind ground was mapped, in seconds; infinite if never.
fn mapped_s(outcome: &Outcome) -> f64 {
    outcome.report.driving.unwrap().mapped_s.unwrap_or(f64::INFINITY)
}

#[test]
fn two_robots_map_a_blind_room_while_links_are_cut() {
    let scenario = written("two_rooms.toml", TWO_ROOMS);
    let options = ["--ideal-cameras", "--cut", "15", "--latency", "10"];
    let report = simulated(&scenario, &options).report;
    let driving = report.driving.unwrap();
    assert_eq!((driving.collisions, driving.touches), (0, 0), "{report}");
    assert!(driving.blind_m2 > 8.0 && driving.blind_mapped >= 0.99, "{report}");
    assert!(report.map.converged, "{report}");
    assert!(report.robots.iter().all(|robot| robot.frames_lost > 50), "the link was cut");
}

/// Checks what the other tests rely on: a robot that collides is stopped, and the collision is
/// counted once.
#[test]
fn a_collision_stops_the_robot_and_is_counted_once() {
    let scenario = Scenario::from_toml(TWO_ROOMS, "two_rooms.toml").unwrap();
    let run = |turn_rad_s: f64, drive_s: f64| {
        let mut world = World::new(&scenario, None, RESOLUTION, 1).unwrap();
        world.tell_wheels(1, 0.0, 0.0);
        world.tell_wheels(0, 0.0, turn_rad_s);
        world.advance(Instant(2_000_000));
        world.tell_wheels(0, 0.4, 0.0);
        let mut all = vec![world.contacts()];
        for tenth in 0..(drive_s * 10.0) as u64 {
            world.advance(Instant(2_000_000 + 100_000 * tenth));
            all.push(world.contacts());
        }
        let robot = &world.robots()[0];
        (*all.last().unwrap(), robot.truth(), robot.radius_m())
    };
    // The robot drives south, where the wall is 1.2 m away.
    let quarter = core::f64::consts::FRAC_PI_4;
    let (contacts, pose, radius) = run(-quarter, 20.0);
    assert_eq!(contacts, Contacts { collisions: 1, touches: 0 });
    assert!((pose.y.metres() - radius).abs() < 0.15 && pose.y.metres() >= radius, "{pose:?}");
    // The robot drives north, where the other robot is 1.6 m away.
    let (contacts, pose, radius) = run(quarter, 20.0);
    assert_eq!(contacts, Contacts { collisions: 1, touches: 0 });
    let apart = 2.8 - pose.y.metres();
    assert!(apart >= 2.0 * radius - 1e-3 && apart < 2.0 * radius + 0.05, "{apart}");
}

/// The fraction of reachable blind ground that was mapped, compared with the best of three sets of
/// scripted routes.
fn against_routes(scenario: &str, duration: &str) {
    let (mut driven, mut best) = (0.0, 0.0);
    for seed in seeds(1) {
        let outcome = run(scenario, seed, &["--duration", duration]);
        let share = outcome.report.driving.unwrap().blind_mapped;
        let by_routes = |set: usize| {
            let file = written(&format!("{scenario}_{set}.toml"), &scripted(scenario, set));
            mapped_s(&run(&file, seed, &["--scripted", "--duration", duration]))
        };
        let routes: Vec<f64> = (0..SETS).map(by_routes).collect();
        let mapped = mapped_s(&outcome);
        println!(
            "| {scenario}, seed {seed} | {:.1} % | {mapped:.0} s | {routes:.0?} s |",
            100.0 * share
        );
        assert!(share >= 0.99, "{}", outcome.report);
        (driven, best) = (driven + mapped, best + routes.into_iter().fold(f64::INFINITY, f64::min));
    }
    println!("| {scenario} | {:.2} x the time of the best routes |", driven / best);
    assert!(driven <= 1.3 * best, "{driven} s against {best} s");
}

#[test]
fn the_blind_ground_of_the_room_is_mapped() {
    let report = run("room", 1, &["--duration", "120"]).report;
    assert!(report.driving.unwrap().blind_mapped >= 0.99, "{report}");
}

#[test]
#[ignore = "prints a table: UBIMAP_SEEDS=10 cargo driving"]
fn robots_map_the_room_within_1_3_times_the_best_script() {
    against_routes("room", "150");
}

#[test]
#[ignore = "prints a table: UBIMAP_SEEDS=10 cargo driving"]
fn robots_map_the_warehouse_within_1_3_times_the_best_script() {
    against_routes("warehouse", "300");
}

#[test]
#[ignore = "prints a table: UBIMAP_SEEDS=10 cargo driving"]
fn two_robots_map_the_warehouse_in_less_time_than_one() {
    let (mut one, mut two) = (0.0, 0.0);
    for seed in seeds(1) {
        let times = ["1", "2"].map(|robots| {
            mapped_s(&run("warehouse", seed, &["--robots", robots, "--duration", "900"]))
        });
        println!(
            "| warehouse, seed {seed} | one robot {:.0} s | two {:.0} s |",
            times[0], times[1]
        );
        (one, two) = (one + times[0], two + times[1]);
    }
    println!("| warehouse | two against one: {:.2} |", two / one);
    assert!(two <= 0.6 * one, "{two} s against {one} s");
}

/// Number of occupied cells within one cell of robots that never drive.
fn drawn_of_standing(outcome: &Outcome, scenario: &Scenario) -> usize {
    let map = &outcome.map;
    let standing = scenario.robots.iter().filter(|robot| robot.route.waypoints_m.is_empty());
    let cells = standing.flat_map(|robot| {
        let [length, width] = robot.box_m.unwrap_or([2.0 * robot.radius_m; 2]);
        let (sin, cos) = robot.start.heading_deg.to_radians().sin_cos();
        (0..map.cells().len()).filter(move |index| {
            let middle = [index % map.width(), index / map.width()].map(|it| it as f64 + 0.5);
            let [x, y] = map.to_map(middle);
            let (x, y) = (x - robot.start.x_m, y - robot.start.y_m);
            let (along, aside) = ((x * cos + y * sin).abs(), (y * cos - x * sin).abs());
            let about = map.resolution_m();
            along <= length / 2.0 + about && aside <= width / 2.0 + about
        })
    });
    cells.filter(|&index| matches!(map.cells()[index], Cell::Occupied | Cell::Movable)).count()
}

/// Ahmed 3: his robots waited after each move until they were localised, and his robots R3 and R4
/// left boundaries in his map.
#[test]
#[ignore = "prints a table: UBIMAP_SEEDS=10 cargo driving"]
fn on_the_move_is_four_times_as_fast_as_stop_and_wait_and_as_good() {
    let scenario = Scenario::read(Path::new("ahmed-2013")).unwrap();
    let (mut times, mut f1) = ([0.0; 2], [0.0; 2]);
    for seed in seeds(1) {
        let outcomes = ["on-the-move", "stop-and-wait"]
            .map(|motion| run("ahmed-2013", seed, &["--motion", motion, "--duration", "600"]));
        let mapped = outcomes.each_ref().map(mapped_s);
        let score = outcomes.each_ref().map(|it| it.report.truth.unwrap().f1_occupied);
        let drawn = outcomes.each_ref().map(|it| drawn_of_standing(it, &scenario));
        println!(
            "| ahmed-2013, seed {seed} | {mapped:.0?} s | F1 {score:.3?} | {drawn:?} cells of R3 and R4 |"
        );
        assert_eq!(drawn[0], 0);
        for way in 0..2 {
            times[way] += mapped[way];
            f1[way] += score[way];
        }
    }
    println!(
        "| ahmed-2013 | on the move against stop-and-wait: {:.2} of the time |",
        times[0] / times[1]
    );
    assert!(times[0] <= 0.25 * times[1], "{times:?}");
    assert!(f1[0] >= f1[1], "{f1:?}");
}

/// With odometry alone, walls are displaced by some cells, and the known ground with them.
#[test]
fn without_a_server_a_robot_explores_and_returns_home() {
    const SEEDS: u8 = 20;
    let (mut sum, mut squares) = (0.0, 0.0);
    for seed in 1..=SEEDS {
        let Alone { known, believed_m, away_m, .. } = explored_alone(seed.into());
        // Drift may have put a wall on home: then the robot ends at the nearest free cell.
        assert!(known >= 0.85 && believed_m < 0.35, "seed {seed}: {known}, {believed_m} m");
        sum += known;
        squares += away_m * away_m;
    }
    let (known, away_m) = (sum / f64::from(SEEDS), (squares / f64::from(SEEDS)).sqrt());
    println!("alone: {known:.3} known, {away_m:.2} m from home (root mean square)");
    assert!(known >= 0.9, "{known}");
    // The robot can be off by as much as its wheels slip, which it can't detect.
    assert!(away_m <= 0.75, "{away_m} m");
}

/// "Explored" would not be true.
#[test]
fn a_robot_without_room_for_its_map_says_so() {
    let Alone { reason, known, believed_m, .. } = explored_alone_with(8, 1);
    assert_eq!(reason, Reason::PoolFull);
    assert!(known < 0.7 && believed_m < 0.2, "{known}, {believed_m} m");
}

/// The result of a robot that explored alone.
struct Alone {
    /// The fraction of the ground that the robot knows.
    known: f64,
    /// The robot's distance from home in metres: according to its own pose, and in truth.
    believed_m: f64,
    away_m: f64,
    /// Why it ended.
    reason: Reason,
}

/// Number of tiles for both rooms.
const ENOUGH_TILES: usize = 32;

/// Lets a robot explore two rooms alone.
fn explored_alone(seed: u64) -> Alone {
    let alone = explored_alone_with(ENOUGH_TILES, seed);
    assert_eq!(alone.reason, Reason::Explored);
    alone
}

/// The world of two rooms.
fn two_rooms(seed: u64) -> World {
    let scenario = Scenario::from_toml(TWO_ROOMS, "two_rooms.toml").unwrap();
    World::new(&scenario, None, RESOLUTION, seed).unwrap()
}

/// The same with this number of tiles.
fn explored_alone_with(own_tiles: usize, seed: u64) -> Alone {
    let mut world = two_rooms(seed);
    world.tell_wheels(1, 0.0, 0.0);
    let simulated = &world.robots()[0];
    let home = simulated.truth();
    let mut own = simulate::config(simulated, 1);
    own.bounds.own_tiles = own_tiles;
    let [speed, turn, _] = simulated.limits();
    let motion =
        Motion { top_speed: speed as f32 * 1e3, top_turn: turn as f32, ..Motion::default() };
    let alone = Some(Waypoint { x: home.x, y: home.y });
    let own = Config { pose_source: PoseSource::Odometry(home), ..own };
    let own = own.with_drive(Driving { motion, alone, ..Driving::default() });
    let mut memory = Memory::<Heap, _>::new(&own.bounds);
    let mut robot = Robot::new(own, &mut memory).unwrap();
    let mut now = Instant(0);
    let mut frame = [0; DEFAULT_FRAME];
    while !matches!(robot.drive().driver().reason(), Reason::Explored | Reason::PoolFull) {
        now = now + Duration::from_millis(10);
        assert!(now < Instant(400_000_000), "{:?}", robot.drive().driver().reason());
        world.advance(now);
        // Between two steps of the drive.
        if now.micros() % 50_000 == 20_000 {
            robot.odometry(now, world.robots()[0].odometry(), now);
        }
        while let Some(scan) = world.poll_scan(now) {
            if scan.robot == 0 {
                // A scan that finds the queue full is dropped.
                let _ = robot.scan(scan.taken, &scan.readings_mm, now);
            }
        }
        robot.timeout(now);
        let command = robot.command();
        world.tell_wheels(0, f64::from(command.speed) / 1e3, f64::from(command.turn) / 1e3);
        while robot.poll_transmit(now, &mut frame).is_some() {}
    }
    assert_eq!(world.contacts(), Contacts::default());
    let reached = world.reachable(world.robots()[0].radius_m(), 0.065);
    let known = reached.iter().filter(|&&(x, y)| {
        let tile = TileId::of_cell(x, y).and_then(|id| robot.own_tiles().find(id));
        let bit = 1 << x.rem_euclid(32);
        tile.is_some_and(|tile| tile.row(y.rem_euclid(32) as usize).known() & bit != 0)
    });
    let (known, all) = (known.count(), reached.len());
    let from_home = |at: Pose| (at.x - home.x).metres().hypot((at.y - home.y).metres());
    let away_m = from_home(world.robots()[0].truth());
    let believed_m = from_home(robot.pose_at(now).unwrap().0);
    println!("alone, seed {seed}: {known} of {all} cells in {now:?}, {away_m:.2} m from home");
    let reason = robot.drive().driver().reason();
    Alone { known: known as f64 / all as f64, believed_m, away_m, reason }
}
