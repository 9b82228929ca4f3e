//! The driver's behaviour in rooms.

use core::f64::consts::TAU;

use proptest::prelude::*;
use ubimap_protocol::units::Angle;

use super::*;

/// 20 cm per letter: 7.6 m by 5.2 m.
const MAZE: &str = "
    ######################################
    #.........#..............#...........#
    #.........#..............#...........#
    #.........#..............#...........#
    #.........#....######....#....#......#
    #.........#....######....#....#......#
    #..............######....#....#......#
    #..............######.........#......#
    #..............######.........#......#
    #.........#..............#....#......#
    #.........#..............#....#......#
    #.........#..............#....#......#
    #############....#############.......#
    #.........#..............#...........#
    #.........#..............#...........#
    #.........#..............#...........#
    #.........#....###.......#...........#
    #..............###.......#######..####
    #..............###...................#
    #..............###...................#
    #.........#..........................#
    #.........#..............#...........#
    #.........#..............#...........#
    #.........#..............#...........#
    #.........#..............#...........#
    ######################################";

const HALL: &str = "
    ####################
    #..................#
    #..................#
    #..................#
    #..................#
    #..................#
    #..................#
    #..................#
    #..................#
    #..................#
    #..................#
    ####################";

/// Two rooms and a door of 80 cm.
const DOOR: &str = "
    ####################
    #.........#........#
    #.........#........#
    #.........#........#
    #..................#
    #..................#
    #..................#
    #..................#
    #.........#........#
    #.........#........#
    #.........#........#
    ####################";

#[test]
fn it_explores_a_maze_on_its_own_map_and_comes_back() {
    for view in [1.5 * core::f64::consts::PI, 1.5] {
        let mut it = Simulation::new(MAZE, 0.8, 0.8);
        it.view = view;
        it.driver.set_task(Task::Explore(Some(point(1.0, 1.0))));
        let seconds = it.until(Reason::Explored, 900.0);
        let (all, known) = it.reachable();
        let share = known as f64 / all as f64;
        std::println!(
            "view {view:.1}: {share:.4} of {all} cells in {seconds:.0} s, {:.1} m",
            it.way / 1e3
        );
        assert!(share >= 0.99, "{share}");
        let home = (it.at.0 - 1_000.0).hypot(it.at.1 - 1_000.0);
        assert!(home < 100.0, "{home} mm from home");
    }
}

#[test]
fn it_reaches_goals_beyond_the_window_and_reports_unreachable_ones() {
    let mut it = Simulation::new(MAZE, 0.8, 0.8).with_map();
    it.go(6.8, 0.8);
    it.until(Reason::Arrived, 60.0);
    assert!((it.at.0 - 6_800.0).hypot(it.at.1 - 800.0) < 60.0, "{:?}", it.at);
    it.go(2.1, 0.8);
    it.until(Reason::NoWay(PlanError::GoalBlocked), 60.0);
    assert_eq!(it.command, DriveCommand::STAND);
    it.go(12.0, 0.8);
    it.until(Reason::NoWay(PlanError::GoalBlocked), 60.0);

    let mut it =
        Simulation::new(&DOOR.replace("#..................#", "#.........#........#"), 0.8, 1.2);
    it = it.with_map();
    it.go(3.0, 1.2);
    it.until(Reason::NoWay(PlanError::Unreachable), 10.0);
    assert_eq!(it.told, [Reason::Driving, Reason::NoWay(PlanError::Unreachable)]);
    assert_eq!(it.command.speed, 0);
    assert!(it.command.turn != 0, "it looks around: the door may have opened");
    it.run(10.0);
    assert_eq!(it.told.len(), 2, "reported once: {:?}", it.told);
    // The door opens.
    it.room = DrawnRoom::new(DOOR);
    it.map.fill(Row::default());
    it = it.with_map();
    it.until(Reason::Arrived, 30.0);
}

/// Walls drawn where nothing stands: column and row, length in cells, and whether it runs north.
type Ghosts = [(i32, i32, i32, bool)];

/// Sends a robot to a place in the door's rooms with such walls. Returns whether it stands still after 30 s, and
/// reports that it drives.
fn searches_for_ever(ghosts: &Ghosts, (x, y): (f64, f64)) -> bool {
    let mut it = Simulation::new(DOOR, 0.8, 1.2).with_map();
    for &(column, row, long, runs_north) in ghosts {
        for step in 0..long {
            let (east, north) = if runs_north { (0, step) } else { (step, 0) };
            it.draw(column + east, row + north, true);
        }
    }
    it.go(x, y);
    it.run(30.0);
    let before = it.at;
    it.run(5.0);
    it.driver.reason() == Reason::Driving && it.at == before
}

/// Where the goal and the robot are in walls of a coarse window, the free cell nearest to both is the robot's own.
#[test]
fn a_goal_that_a_coarse_window_sees_at_the_robot_itself_is_not_there() {
    let ghosts = [(20, 32, 4, true), (28, 20, 9, false), (28, 10, 19, true)];
    assert!(!searches_for_ever(&ghosts, (1.635, 0.5)));
    assert!(!searches_for_ever(&ghosts, (1.635, 1.272)));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn it_does_not_search_for_ever(
        ghosts in prop::collection::vec((0..60, 0..48, 1..20, any::<bool>()), 1..12),
        goal in (0.5..3.5, 0.5..2.0),
    ) {
        prop_assert!(!searches_for_ever(&ghosts, goal));
    }
}

#[test]
fn it_stops_before_a_door_that_closes_across_its_path() {
    let closed = DOOR.replace("#..................#", "#.........#........#");
    for is_drawn in [true, false] {
        let mut it = Simulation::new(DOOR, 0.8, 1.2).with_map();
        it.go(3.0, 1.2);
        it.run(1.5);
        assert!(it.command.speed > 100);
        it.room = DrawnRoom::new(&closed);
        if is_drawn {
            it = it.with_map();
        }
        it.until(Reason::NoWay(PlanError::Unreachable), 30.0);
        assert!(it.at.0 < 2_000.0);
    }
}

#[test]
fn one_that_was_held_up_does_what_it_is_told_next() {
    let mut it = Simulation::new(DOOR, 0.8, 1.2).with_map();
    it.go(3.0, 1.2);
    while it.at.0 < 1_650.0 {
        it.step();
    }
    it.room = DrawnRoom::new(&DOOR.replace("#..................#", "#.........#........#"));
    it.until(Reason::Person, 30.0);
    it.driver.set_task(Task::Stand);
    it.run(1.0);
    it.told.clear();
    it.driver.go_to_next(point(0.8, 1.2));
    it.until(Reason::Arrived, 30.0);
    assert_eq!(it.told, [Reason::Driving, Reason::Arrived]);
}

#[test]
fn it_waits_for_people_who_cross_and_never_touches_them() {
    let (mut crossed, mut longest) = (0, 0.0f64);
    for is_told in [true, false] {
        for start in 0..20 {
            let mut it = Simulation::new(HALL, 0.6, 1.2).with_map();
            it.is_told = is_told;
            let person = Person {
                from: (1_900.0, 4_600.0),
                to: (1_900.0, -2_000.0),
                walked: 0.0,
                back: false,
                waits: false,
                stands: false,
                fidgets: 0.0,
                is_at_rest: false,
            };
            it.people.push(person);
            it.run(0.1 * f64::from(start));
            it.go(3.4, 1.2);
            let seconds = it.until(Reason::Arrived, 120.0);
            crossed += it.told.contains(&Reason::Person) as u32;
            longest = longest.max(seconds);
        }
    }
    std::println!("waited for a person in {crossed} of 40 runs, at most {longest:.1} s");
    assert!(crossed > 10);
}

#[test]
fn it_passes_a_person_who_stays_in_the_way() {
    for is_told in [true, false] {
        let mut it = Simulation::new(HALL, 0.6, 1.2).with_map();
        it.is_told = is_told;
        let at = (2_000.0, 1_200.0);
        let to = (2_000.0, 0.0);
        it.people.push(Person { from: at, to, ..STAYS });
        it.go(3.4, 1.2);
        it.until(Reason::Arrived, 60.0);
    }
}

/// A person who stays in the way.
const STAYS: Person = Person {
    from: (2_000.0, 1_200.0),
    to: (2_000.0, 0.0),
    walked: 0.0,
    back: false,
    waits: false,
    stands: true,
    fidgets: 0.0,
    is_at_rest: false,
};

#[test]
fn it_does_not_wait_for_a_person_who_sits_and_keeps_farther_away() {
    let run = |fidgets: f64, is_at_rest: bool| {
        let mut it = Simulation::new(HALL, 0.6, 1.2).with_map();
        it.people.push(Person { fidgets, is_at_rest, ..STAYS });
        it.go(3.4, 1.2);
        it.run(30.0);
        let has_arrived = it.driver.reason() == Reason::Arrived;
        (has_arrived, it.told.contains(&Reason::Person), it.nearest - RADIUS - Person::RADIUS)
    };
    let (still, stands, sits) = (run(0.0, false), run(150.0, false), run(150.0, true));
    std::println!("arrived, waited, gap in mm: still {still:?}, stands {stands:?}, sits {sits:?}");
    // One who seems to walk is waited for; by one who sits it passes without waiting.
    assert!(!stands.0 && stands.1 && still.0);
    assert!(sits.0 && !sits.1 && sits.2 > still.2 + 100.0);
}

#[test]
fn it_stops_without_link_pose_or_scan_and_resumes_with_them() {
    type Fault = fn(&mut Simulation, bool);
    let faults: [(Fault, Reason, f64); 3] = [
        (|it, on| it.link = !on, Reason::LinkLost, 2.1),
        (|it, on| it.sees = !on, Reason::SensorLost, 0.7),
        (|it, on| it.stop = on, Reason::Stopped, 0.1),
    ];
    for (fault, reason, within) in faults {
        let mut it = Simulation::new(HALL, 0.6, 1.2).with_map();
        it.go(3.4, 1.2);
        it.run(2.0);
        assert!(it.command.speed > 100);
        fault(&mut it, true);
        it.until(reason, within);
        assert_eq!(it.command, DriveCommand::STAND);
        let at = it.at;
        it.run(10.0);
        assert!(it.at == at && it.command == DriveCommand::STAND);
        fault(&mut it, false);
        it.until(Reason::Arrived, 30.0);
        assert_eq!(it.told, [Reason::Driving, reason, Reason::Driving, Reason::Arrived]);
    }
}

#[test]
fn it_turns_on_the_spot_while_it_does_not_know_where_it_is() {
    let mut it = Simulation::new(HALL, 0.6, 1.2).with_map();
    it.go(3.4, 1.2);
    it.run(2.0);
    it.unsure = 600.0;
    it.until(Reason::PoseLost, 0.1);
    let at = it.at;
    it.run(2.0);
    assert!((it.at.0, it.at.1) == (at.0, at.1) && it.at.2 != at.2);
    assert!(it.command.turn > 200, "{:?}", it.command);
    // It gives up for a while.
    it.run(20.0);
    assert_eq!((it.command, it.driver.reason()), (DriveCommand::STAND, Reason::PoseLost));
    it.run(157.0);
    assert_eq!(it.command, DriveCommand::STAND);
    it.run(2.0);
    assert!(it.command.turn > 200, "{:?}", it.command);
    // Without a scan, or with nowhere to go, it stands.
    it.sees = false;
    it.until(Reason::SensorLost, 0.7);
    assert_eq!(it.command, DriveCommand::STAND);
    it.sees = true;
    it.until(Reason::PoseLost, 0.2);
    it.unsure = 20.0;
    it.until(Reason::Arrived, 30.0);
    it.unsure = 600.0;
    it.driver.set_task(Task::Stand);
    it.until(Reason::PoseLost, 0.2);
    assert_eq!(it.command, DriveCommand::STAND);
}

#[test]
fn it_stops_when_wheels_fail() {
    for (wheels, reason) in
        [(Wheels::Blocked, Reason::WheelsStuck), (Wheels::Slip, Reason::WheelsSlip)]
    {
        let mut it = Simulation::new(HALL, 0.6, 1.2).with_map();
        it.go(3.4, 1.2);
        it.run(2.0);
        it.wheels = wheels;
        let seconds = it.until(reason, 2.5);
        std::println!("{reason:?} after {seconds:.2} s");
        it.run(60.0);
        assert_eq!((it.driver.reason(), it.command), (reason, DriveCommand::STAND));
        assert_eq!(it.told, [Reason::Driving, reason], "reported once, despite the retries");
        it.wheels = Wheels::Work;
        it.go(3.4, 1.2);
        it.until(Reason::Arrived, 30.0);
    }
}

#[test]
fn the_same_room_is_driven_the_same_way() {
    let drive = || {
        let mut it = Simulation::new(MAZE, 0.8, 0.8);
        it.driver.set_task(Task::Explore(None));
        it.run(20.0);
        (it.at, it.command, it.told)
    };
    assert!(drive() == drive());
}

/// Ahmed's method: a camera that sees the floor, no map.
#[test]
fn it_follows_a_boundary_around_a_room_by_the_distance_vector() {
    use crate::sense::{COLUMNS, ScaleCurve, TABLE_1};
    let curve = ScaleCurve::fit(&TABLE_1).unwrap().scaled(2.5);
    let mut follower = BoundaryFollower::default();
    let mut it = Simulation::new(HALL, 2.0, 1.2);
    let mut quarters = [false; 4];
    for _ in 0..4_000 {
        let (x, y, heading) = it.at;
        let distances: [u8; COLUMNS] = core::array::from_fn(|column| {
            // The columns cover 90 degrees, from left to right.
            let bearing = heading + TAU / 8.0 - TAU / 4.0 * column as f64 / COLUMNS as f64;
            let (sin, cos) = bearing.sin_cos();
            let wall = (1..600).map(|step| f64::from(step) * 5.0).find(|way| {
                let at = |from: f64, along: f64| ((from + along * way) / CELL).floor() as i32;
                it.room.is_wall(at(x, cos), at(y, sin))
            });
            let pixels = wall.and_then(|way| {
                (62..=121u8).find(|&it| curve.distance(it).is_some_and(|far| f64::from(far) >= way))
            });
            // 50 and 124 pixels stand for distances outside the range of the scale curve.
            if wall.is_some_and(|way| way < 185.0) { 50 } else { pixels.unwrap_or(124) }
        });
        let command = follower.step(&distances, STEP as f32);
        let (speed, turn) = (f64::from(command.speed), f64::from(command.turn) / 1_000.0);
        let heading = heading + turn * STEP;
        it.at = (x + speed * STEP * heading.cos(), y + speed * STEP * heading.sin(), heading);
        let wall = it.room.nearest_wall(it.at.0, it.at.1);
        assert!(wall > 75.0, "{wall} mm from a wall at {:?}", it.at);
        if wall < 600.0 {
            quarters[(it.at.0 > 2_000.0) as usize + 2 * (it.at.1 > 1_200.0) as usize] = true;
        }
    }
    assert_eq!(quarters, [true; 4]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn no_input_makes_it_panic_or_drive_too_fast(
        steps in prop::collection::vec((
            any::<u64>(), any::<(i32, i32, u16)>(), any::<f32>(), any::<(i32, i32, u16)>(),
            any::<(i16, i16, u16, [bool; 2])>(), any::<(u32, u32)>(), 0..6u8, any::<(i32, i32)>(),
        ), 1..60),
    ) {
        let mut driver = driver();
        let pose = |(x, y, heading): (i32, i32, u16)| {
            Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle(heading) }
        };
        for (time, at, unsure, odometry, (vx, vy, radius, person), ground, task, goal) in steps {
            let goal = Waypoint { x: Millimetres(goal.0), y: Millimetres(goal.1) };
            match task {
                0 => driver.set_task(Task::Go(goal)),
                1 => driver.set_task(Task::Explore(Some(goal))),
                _ => {}
            }
            let now = Instant(time);
            let mut beams = [Beam::default(); 70];
            let model = SensorModel::Radial { first: 0.0, step: 0.09 };
            fill_beams(&mut beams, model, Pose::default());
            let readings = [radius; 70];
            let mounting = pose(odometry);
            let near = NearPoints::of_scan(&Seen {
                taken: now,
                readings: &readings,
                beams: &beams,
                validity: Validity::default(),
                mounting,
            });
            let health = Health {
                now,
                heard: Some(now),
                must_stop: false,
                pose: Some((pose(at), unsure.abs().min(100.0))),
                odometry: Some(pose(odometry)),
                scan: Some(now),
            };
            let mover = Mover {
                x: Millimetres(at.0),
                y: goal.y,
                velocity_x: vx,
                velocity_y: vy,
                radius,
                is_person: person[0],
                is_at_rest: person[1],
            };
            let inputs = Inputs { health, near: &near, movers: &[mover], cells_refused: 0 };
            let cells = Row { low: ground.0, high: ground.1 };
            for _ in 0..8 {
                let command = driver.step(&inputs, |column, row| {
                    let covered = (column ^ row) as u32;
                    GroundRow { cells, covered }
                });
                let motion = Motion::default();
                prop_assert!((0..=motion.top_speed as i16).contains(&command.speed));
                prop_assert!(f32::from(command.turn).abs() <= 1_000.0 * motion.top_turn + 1.0);
            }
        }
    }
}
