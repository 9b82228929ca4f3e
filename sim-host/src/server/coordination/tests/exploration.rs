//! Exploration of unknown ground.

use ubimap_protocol::tile::Cell;

use super::{
    floor::{Floor, RADIUS_M, id},
    plan::{Plan, middle, set},
};
use crate::server::coordination::{
    Errand, Notice, Unexplored, WhyUnexplored, ground::Point, member::Member,
    odometry_calibration::OdometryCalibration,
};

/// Corridors and rooms, 12 m by 8 m.
fn maze() -> Plan {
    let mut plan = Plan::room(12.0, 8.0);
    for (x, from, to) in [(2.0, 0.0, 6.4), (4.0, 1.6, 8.0), (6.0, 0.0, 5.0), (8.0, 2.4, 8.0)] {
        plan.wall(x, from, x + 0.1, to);
    }
    plan.wall(8.1, 2.4, 10.4, 2.5);
    plan.wall(9.6, 5.0, 12.0, 5.1);
    plan
}

/// Lets robots explore a plan.
fn exploring(plan: Plan, starts: &[Point], seed: u64) -> Floor {
    let mut floor = Floor::new(plan, starts, seed, |_| true);
    floor.look_around();
    for index in 0..starts.len() {
        assert!(floor.coordinator.set_exploring(id(index), true));
    }
    floor
}

/// A chamber behind a passage of a metre that is too narrow for a robot.
#[test]
fn what_is_left_is_told_with_the_reason() {
    let mut plan = Plan::room(8.0, 4.0);
    plan.wall(6.0, 0.0, 7.0, 1.7);
    plan.wall(6.0, 2.0, 7.0, 4.0);
    let mut floor = exploring(plan, &[Point::new(1.0, 2.0)], 1);
    floor.run(2, |_| false);
    let left = floor.coordinator.unexplored();
    assert!(
        !left.is_empty() && left.iter().any(|it| it.why == WhyUnexplored::IsTarget),
        "{left:?}"
    );
    // The border has a piece for each metre.
    let apart = |one: &Unexplored, other: &Unexplored| {
        let [x, y] = [0, 1].map(|axis| one.place_m[axis] - other.place_m[axis]);
        one.why != other.why || x.hypot(y) > floor.coordinator.settings.view_m
    };
    assert!(floor.coordinator.frontiers.len() > left.len());
    for (at, one) in left.iter().enumerate() {
        assert!(left[at + 1..].iter().all(|other| apart(one, other)), "{left:?}");
        assert!(left[at + 1..].iter().all(|other| one.area_m2 >= other.area_m2), "{left:?}");
    }
    floor.run(120, |floor| {
        floor.look_around();
        false
    });
    let left = floor.coordinator.unexplored();
    println!("{left:?}");
    assert!(!left.is_empty() && left.iter().all(|it| it.place_m[0] > 6.0), "{left:?}");
    let is_told =
        |it: &Unexplored| matches!(it.why, WhyUnexplored::OutOfReach | WhyUnexplored::SeenInVain);
    assert!(left.iter().all(is_told), "{left:?}");
}

/// Cameras see the western half; the robots look at what is hidden in the east, and return.
#[test]
fn robots_return_into_view_when_nothing_is_left_to_look_at() {
    let plan = Plan::room(8.0, 4.0);
    let starts = [Point::new(1.0, 1.0), Point::new(1.0, 3.0)];
    let mut floor = exploring(plan, &starts, 1);
    floor.cover(|it| it.x < 4.0);
    let mut farthest = 0.0_f64;
    let mut run = |floor: &mut Floor, seconds| {
        floor.run(seconds, |floor| {
            floor.look_around();
            farthest = floor.bodies.iter().map(|body| body.place.x).fold(farthest, f64::max);
            false
        });
        farthest
    };
    assert!(run(&mut floor, 60) > 4.5, "they have looked");
    for (index, body) in floor.bodies.iter().enumerate() {
        assert!(body.place.x < 4.0, "{}", body.place);
        assert_eq!(floor.coordinator.errand(id(index)), Some(Errand::Waits));
    }
    assert_eq!(floor.count(Notice::Reached), 0, "nobody has sent them");
    // A goal of a user keeps them where they are sent.
    floor.coordinator.goal(id(0), 7.0, 2.0, floor.now).unwrap();
    assert!(floor.run(60, |floor| floor.count(Notice::Reached) == 1));
    assert!(!floor.run(3, |floor| floor.bodies[0].place.x < 6.0));
    assert!(floor.run(40, |floor| floor.bodies[0].place.x < 4.0), "it explores still");
    assert!(!floor.is_blocked());
}

/// Cameras see the westernmost rooms of twelve metres of them.
#[test]
fn robots_come_into_view_before_their_poses_drift_far() {
    let [(endless, all), (recalled, known)] = [f64::INFINITY, 8.0].map(|blind_m| {
        let mut floor = exploring(rooms(), &[Point::new(1.5, 4.0)], 1);
        floor.cover(|it| it.x < 3.0);
        floor.coordinator.settings.exploration.blind_m = blind_m;
        floor.coordinator.settings.calibration.distance_m = 0.0;
        let (mut left, mut farthest, mut is_recalled) = (0.0, 0.0_f64, false);
        let mut busy = floor.now;
        floor.run_looking(400, |floor| {
            let body = &floor.bodies[0];
            if floor.is_in_view(body.place) {
                left = body.driven;
            }
            farthest = farthest.max(body.driven - left);
            let errand = floor.coordinator.errand(id(0));
            is_recalled |= matches!(errand, Some(Errand::Recalled(_)));
            if errand != Some(Errand::Waits) {
                busy = floor.now;
            }
            floor.now.since(busy).micros() > 5_000_000
        });
        assert_eq!(is_recalled, blind_m.is_finite());
        assert!(!floor.is_blocked());
        (farthest, known(&floor).0)
    });
    println!("at most {endless:.1} m out of view, with recalls {recalled:.1} m");
    // Nothing is farther than 12 m away, and the way back is not counted before.
    assert!(recalled < 8.0 + 14.0 && endless > recalled + 10.0, "{endless}, {recalled}");
    assert!(f64::from(known) > 0.99 * f64::from(all), "all is explored: {known} of {all} cells");
}

/// A robot that explores two rows of rooms, 12 m long; cameras see the ground where `is_seen` holds.
fn calibrating(distance_m: f64, blind_m: f64, is_seen: impl Fn(Point) -> bool) -> Floor {
    let mut floor = exploring(rooms(), &[Point::new(1.0, 4.0)], 1);
    let rules = &mut floor.coordinator.settings.calibration;
    (rules.distance_m, rules.blind_m) = (distance_m, blind_m);
    floor.cover(is_seen);
    floor
}

/// Runs for 400 s. Returns the distance that the robot drives to calibrate its odometry, the maximum distance that it drives out of
/// view before, both in metres; whether it was recalled; and the number of known cells at the end.
fn calibrated(mut floor: Floor) -> (f64, f64, bool, u32) {
    let (mut way, mut left, mut farthest) = (0.0, 0.0, 0.0_f64);
    let (mut driven, mut is_recalled) = (0.0, false);
    floor.run_looking(400, |floor| {
        let body = &floor.bodies[0];
        let step = body.driven - core::mem::replace(&mut driven, body.driven);
        let errand = floor.coordinator.errand(id(0));
        is_recalled |= matches!(errand, Some(Errand::Recalled(_)));
        if matches!(errand, Some(Errand::Calibrates(_))) {
            way += step;
        }
        if floor.is_in_view(body.place) {
            left = body.driven;
        }
        if way == 0.0 {
            farthest = farthest.max(body.driven - left);
        }
        false
    });
    assert!(!floor.is_blocked());
    (way, farthest, is_recalled, known(&floor).0)
}

#[test]
fn a_robot_calibrates_its_odometry_in_view_before_it_goes_far() {
    let run = |distance_m, blind_m| calibrated(calibrating(distance_m, blind_m, |it| it.x < 3.0));
    let (none, .., all) = run(0.0, 2.0);
    let (way, farthest, is_recalled, known) = run(10.0, 2.0);
    let (_, late, ..) = run(10.0, 20.0);
    println!(
        "{way:.1} m to calibrate, before {farthest:.1} and {late:.1} m out of view; {known} of {all} known"
    );
    assert_eq!(none, 0.0);
    // The rest of the 10 m was driven in view earlier.
    assert!(is_recalled && (5.0..12.0).contains(&way), "{way}");
    assert!(farthest + 8.0 < late, "{farthest}, {late}");
    assert!(f64::from(known) > 0.99 * f64::from(all), "{known} of {all}");
}

/// Cameras see all but four metres in the middle.
#[test]
fn a_robot_that_explores_only_close_to_the_view_does_not_calibrate_its_odometry() {
    let is_seen = |it: Point| !(4.0..8.0).contains(&it.x);
    let (way, farthest, is_recalled, _) = calibrated(calibrating(10.0, 2.0, is_seen));
    println!("{way:.1} m to calibrate, {farthest:.1} m out of view");
    assert!(farthest > 2.0, "{farthest}");
    assert!(way == 0.0 && !is_recalled, "{way}");
}

/// Cameras see a disc with a diameter of 1.1 m, less than the minimum length of a way.
#[test]
fn where_there_is_no_way_in_view_to_calibrate_odometry_robots_explore_all_the_same() {
    let is_seen = |it: Point| (it - Point::new(1.0, 4.0)).norm() < 0.55;
    let [(.., all), (way, _, is_recalled, known)] =
        [0.0, 10.0].map(|distance_m| calibrated(calibrating(distance_m, 2.0, is_seen)));
    println!("{way:.1} m; {known} of {all} known");
    assert!(is_recalled && way < 0.5, "{way}");
    assert!(f64::from(known) > 0.99 * f64::from(all), "{known} of {all}");
}

/// The robot has lost its tag.
#[test]
fn a_robot_that_cameras_do_not_see_where_they_see_the_ground_explores_on() {
    let mut floor = calibrating(10.0, 2.0, |it| it.x < 3.0);
    floor.has_tags = false;
    let (way, _, is_recalled, known) = calibrated(floor);
    let (.., all) = calibrated(calibrating(0.0, 2.0, |it| it.x < 3.0));
    println!("{way:.1} m; {known} of {all} known");
    assert!(is_recalled);
    assert!(f64::from(known) > 0.99 * f64::from(all), "{known} of {all}");
}

/// Whether the robot drives to and fro to calibrate its odometry.
fn calibrates(floor: &mut Floor) -> bool {
    matches!(floor.coordinator.errand(id(0)), Some(Errand::Calibrates(_)))
}

#[test]
fn a_goal_interrupts_the_calibration_of_odometry() {
    let mut floor = calibrating(10.0, 2.0, |it| it.x < 3.0);
    let in_view = |floor: &mut Floor| calibrates(floor) && floor.is_in_view(floor.bodies[0].place);
    assert!(floor.run_looking(200, in_view));
    let out_of_view = [6.0, 4.0];
    floor.coordinator.goal(id(0), out_of_view[0], out_of_view[1], floor.now).unwrap();
    assert_eq!(floor.coordinator.errand(id(0)), Some(Errand::Goal(out_of_view)));
    assert!(floor.run_looking(60, |floor| floor.count(Notice::Reached) == 1));
    assert!(floor.run_looking(100, in_view), "it goes on with it");
}

#[test]
fn a_robot_that_has_booted_calibrates_its_odometry_again() {
    let mut floor = calibrating(10.0, 2.0, |it| it.x < 3.0);
    assert!(floor.run_looking(200, calibrates));
    assert!(floor.run_looking(100, |floor| !calibrates(floor)));
    assert!(!floor.run_looking(60, calibrates), "it is calibrated");
    floor.coordinator.booted(id(0));
    assert!(floor.run_looking(60, calibrates));
}

#[test]
fn a_calibration_that_fails_is_tried_again_later_each_time() {
    let mut floor = calibrating(10.0, 2.0, |it| it.x < 3.0);
    floor.run(1, |_| false);
    let (now, settings) = (floor.now, floor.coordinator.settings);
    let member = &mut floor.coordinator.members[0];
    let minutes = |member: &mut Member| {
        member.calibration = OdometryCalibration::Due;
        member.fail_calibration(&settings, now);
        let OdometryCalibration::Missing(until) = member.calibration else { panic!() };
        until.since(now).micros() / 60_000_000
    };
    assert_eq!([(); 6].map(|()| minutes(member)), [2, 4, 8, 16, 32, 32]);
    member.lose_calibration();
    assert_eq!(minutes(member), 2);
}

#[test]
fn a_recalled_robot_that_must_not_explore_any_more_has_nothing_to_do() {
    let mut floor = calibrating(10.0, 2.0, |it| it.x < 3.0);
    let is_recalled =
        |floor: &mut Floor| matches!(floor.coordinator.errand(id(0)), Some(Errand::Recalled(_)));
    assert!(floor.run_looking(200, is_recalled));
    assert!(floor.coordinator.set_exploring(id(0), false));
    floor.run(5, |_| false);
    assert_eq!(floor.coordinator.errand(id(0)), Some(Errand::Idle));
}

/// Runs until all ground is known, or for a limited time. Checks that no two robots go to the same
/// frontier at the same time. Returns the duration in seconds, the known fraction of the ground
/// that can be seen, and the floor.
fn explore(mut floor: Floor) -> (u64, f64, Floor) {
    let robots = floor.bodies.len();
    let mut idle_since = floor.now;
    floor.run_looking(900, |floor| {
        let targets: Vec<_> =
            (0..robots).filter_map(|it| floor.coordinator.target(id(it))).collect();
        for (at, one) in targets.iter().enumerate() {
            for other in &targets[at + 1..] {
                let apart = (one[0] - other[0]).hypot(one[1] - other[1]);
                assert!(apart > 1.0, "two robots have the same frontier: {one:?}, {other:?}");
            }
        }
        if !targets.is_empty() {
            idle_since = floor.now;
        }
        floor.now.since(idle_since).micros() > 5_000_000
    });
    let (known, all) = known(&floor);
    (idle_since.micros() / 1_000_000, f64::from(known) / f64::from(all), floor)
}

/// Number of free cells that are known, and of all.
fn known(floor: &Floor) -> (u32, u32) {
    let (mut known, mut all) = (0, 0);
    for cell in floor.plan.places().filter(|it| floor.plan.cell(middle(*it)) == Cell::Free) {
        all += 1;
        known += u32::from(!floor.is_unknown(cell));
    }
    (known, all)
}

/// Eight rooms on both sides of a corridor.
fn rooms() -> Plan {
    let mut plan = Plan::room(12.0, 8.0);
    for column in 0..4 {
        let west = 3.0 * f64::from(column);
        for (south, north) in [(0.0, 3.2), (4.8, 8.0)] {
            plan.wall(west - 0.05, south, west + 0.05, north);
        }
        for y in [3.2, 4.7] {
            plan.wall(west, y, west + 1.0, y + 0.1);
            plan.wall(west + 1.9, y, west + 3.0, y + 0.1);
        }
    }
    plan
}

fn report(floor: &Floor, known: f64, seconds: u64) {
    let driven: f64 = floor.bodies.iter().map(|body| body.driven).sum();
    println!(
        "{} robots: {:.2} % known in {seconds} s, {driven:.0} m driven, {} paths, slowest tick {:?}",
        floor.bodies.len(),
        known * 100.0,
        floor.paths,
        floor.slowest_tick,
    );
    assert!(known > 0.999, "{known}");
    assert!(!floor.is_blocked(), "{} {}", floor.overlaps, floor.collisions);
}

#[test]
#[ignore = "long: cargo thorough"]
fn a_maze_is_explored_completely() {
    let starts = [Point::new(1.0, 0.6), Point::new(1.0, 1.6)];
    let (seconds, known, floor) = explore(exploring(maze(), &starts, 1));
    report(&floor, known, seconds);
}

#[test]
#[ignore = "long: cargo thorough"]
fn three_robots_share_rooms() {
    let starts = [Point::new(1.0, 4.0), Point::new(2.0, 4.0), Point::new(3.0, 4.0)];
    let mut times = Vec::new();
    for robots in [1, 3] {
        let (seconds, known, floor) = explore(exploring(rooms(), &starts[..robots], 1));
        report(&floor, known, seconds);
        times.push(seconds);
    }
    assert!(times[1] as f64 <= 0.6 * times[0] as f64, "{times:?}");
}

#[test]
fn people_in_the_corridor_delay_but_do_not_stop_robots() {
    let starts = [Point::new(1.0, 4.0), Point::new(2.0, 4.0), Point::new(3.0, 4.0)];
    let mut floor = exploring(rooms(), &starts, 1);
    floor.people = vec![(Point::new(8.0, 4.3), 0.7), (Point::new(10.0, 3.7), -0.5)];
    let (seconds, known, floor) = explore(floor);
    report(&floor, known, seconds);
}

#[test]
fn a_goal_takes_precedence_over_exploration() {
    let mut floor = exploring(rooms(), &[Point::new(1.0, 4.0)], 1);
    floor.run(3, |_| false);
    assert!(floor.coordinator.target(id(0)).is_some());
    floor.coordinator.goal(id(0), 1.4, 3.9, floor.now).unwrap();
    assert_eq!(floor.coordinator.target(id(0)), None);
    assert!(floor.run(60, |floor| floor.count(Notice::Reached) == 1));
    let there = Point::new(1.4, 3.9);
    assert!((floor.bodies[0].place - there).norm() < 0.3, "{}", floor.bodies[0].place);
    assert!(floor.run(3, |floor| floor.coordinator.target(id(0)).is_some()));
}

/// Ground behind a wall without a door can't be explored; robots must stop trying.
#[test]
fn ground_out_of_reach_is_left_alone() {
    let mut plan = Plan::room(6.0, 4.0);
    plan.wall(4.0, 0.0, 4.1, 4.0);
    let starts = [Point::new(1.0, 1.0), Point::new(1.0, 3.0)];
    let (time, known, floor) = explore(exploring(plan, &starts, 2));
    println!("{:.1} % known in {time} s", known * 100.0);
    assert!(known > 0.6 && known < 0.7 && time < 60, "{known} {time}");
    assert!(
        !floor.is_blocked()
            && floor.bodies.iter().all(|it| floor.plan.room_around(it.place) > RADIUS_M)
    );
}

/// A person in a doorway was drawn as a wall, and then left.
#[test]
fn a_stale_obstacle_in_the_only_way_is_checked_again() {
    let mut plan = Plan::room(9.0, 4.0);
    plan.wall(4.0, 0.0, 4.1, 1.5);
    plan.wall(4.0, 2.5, 4.1, 4.0);
    // The frontier is only visible from beyond the door.
    let mut floor = Floor::new(plan, &[Point::new(2.6, 2.0)], 1, |place| place.x > 6.6);
    assert!(floor.coordinator.set_exploring(id(0), true));
    let ghost = (37..40).map(|y| (80, y));
    set(&mut floor.fused, ghost.clone().map(|it| (it, Cell::Occupied)));
    let is_gone = |floor: &Floor| floor.bodies[0].driven > 0.4;
    let before = floor.bodies[0].place;
    floor.run(20, |floor| {
        floor.look_around();
        is_gone(floor)
    });
    assert!(is_gone(&floor), "it is still at {before}");
    set(&mut floor.fused, ghost.map(|it| (it, Cell::Free)));
    let (seconds, known, floor) = explore(floor);
    report(&floor, known, seconds);
}

/// Robot 0 in a chamber whose door seems shut, and robot 1 with much left to explore. Returns the floor and the cells
/// that shut the door.
fn shut_in() -> (Floor, Vec<(i32, i32)>) {
    let mut plan = Plan::room(40.0, 4.0);
    plan.wall(4.0, 0.0, 4.1, 1.5);
    plan.wall(4.0, 2.5, 4.1, 4.0);
    let starts = [Point::new(1.0, 2.0), Point::new(6.0, 2.0)];
    let mut floor = Floor::new(plan, &starts, 1, |place| place.x > 8.0);
    let ghost: Vec<_> = (30..50).map(|y| (80, y)).collect();
    set(&mut floor.fused, ghost.iter().map(|it| (*it, Cell::Occupied)));
    (0..2).for_each(|index| assert!(floor.coordinator.set_exploring(id(index), true)));
    (floor, ghost)
}

/// Somebody walked through the door behind a robot, was drawn there, and has left.
#[test]
fn a_robot_that_is_shut_in_looks_at_what_shuts_it_in_while_others_explore() {
    let (mut floor, ghost) = shut_in();
    let is_looking =
        |floor: &Floor| matches!(floor.coordinator.errand(id(0)), Some(Errand::LooksForWay(_)));
    assert!(floor.run(60, |floor| {
        floor.look_around();
        is_looking(floor)
    }));
    let waited = floor.now.micros();
    assert!((20_000_000..22_000_000).contains(&waited), "it is patient with others: {waited}");
    assert_eq!(floor.coordinator.target(id(0)), None, "the frontier is for the other one");
    assert!(floor.coordinator.target(id(1)).is_some());
    assert!(floor.run(30, |floor| {
        floor.look_around();
        !is_looking(floor)
    }));
    let place = floor.bodies[0].place;
    assert!(place.x > 3.0, "it has looked from where the door is: {place}");
    set(&mut floor.fused, ghost.into_iter().map(|it| (it, Cell::Free)));
    assert!(floor.run(60, |floor| {
        floor.look_around();
        floor.bodies[0].place.x > 5.0
    }));
    assert!(!floor.is_blocked());
}

#[test]
fn a_robot_that_finds_no_way_out_keeps_still_and_leaves_the_frontiers_to_others() {
    let (mut floor, _) = shut_in();
    let (mut looks, mut looked) = (0, false);
    floor.run(200, |floor| {
        floor.look_around();
        let looks_now = matches!(floor.coordinator.errand(id(0)), Some(Errand::LooksForWay(_)));
        looks += u32::from(looks_now && !looked);
        looked = looks_now;
        false
    });
    assert_eq!(looks, 3);
    assert_eq!(floor.count(Notice::ShutIn), 0);
    assert_eq!(floor.coordinator.errand(id(0)), Some(Errand::Waits));
    let (known, all) = known(&floor);
    assert!(f64::from(known) > 0.99 * f64::from(all), "{known} of {all} cells");
    assert!(!floor.is_blocked());
}

/// A person stops in the only door, is drawn there, and leaves: the robot does not set out for the far
/// end meanwhile.
#[test]
fn a_person_in_the_only_door_does_not_cost_the_target() {
    let mut plan = Plan::room(12.0, 4.0);
    plan.wall(8.0, 0.0, 8.1, 1.5);
    plan.wall(8.0, 2.5, 8.1, 4.0);
    let is_hidden = |place: Point| place.x > 10.0 || place.x < 1.0;
    let mut floor = Floor::new(plan, &[Point::new(6.2, 2.0)], 1, is_hidden);
    let body = (29..50).flat_map(|y| (157..162).map(move |x| (x, y)));
    assert!(floor.coordinator.set_exploring(id(0), true));
    assert!(floor.run(20, |floor| floor.bodies[0].place.x > 7.2), "it does not go to the door");
    floor.people = vec![(Point::new(8.0, 2.0), 0.0)];
    assert!(floor.run(1, |floor| floor.bodies[0].is_blocked()));
    set(&mut floor.fused, body.clone().map(|it| (it, Cell::Occupied)));
    let keeps_target = |floor: &mut Floor| {
        if let Some([x, _]) = floor.coordinator.target(id(0)) {
            assert!(x > 8.0, "at {:?} it goes to {x}", floor.now);
        }
        floor.bodies[0].place.x > 8.5
    };
    assert!(!floor.run(5, keeps_target));
    assert_eq!(floor.count(Notice::Blocked), 1);
    floor.people.clear();
    set(&mut floor.fused, body.map(|it| (it, Cell::Free)));
    assert!(floor.run(12, keeps_target), "it is still at {}", floor.bodies[0].place);
}

/// Its own drawing of the walls has left a robot so little room that it can look nowhere else for a way out.
#[test]
fn a_robot_that_has_nowhere_to_look_for_a_way_out_is_told_once() {
    let starts = [Point::new(1.025, 2.025), Point::new(6.0, 2.0)];
    let mut floor = Floor::new(Plan::room(150.0, 4.0), &starts, 1, |place| place.x > 8.0);
    let side = |at: i32| [(at, -8), (at, 8), (-8, at), (8, at)];
    let walls: Vec<_> = (-8..=8).flat_map(side).map(|(x, y)| (20 + x, 40 + y)).collect();
    set(&mut floor.fused, walls.iter().map(|it| (*it, Cell::Occupied)));
    (0..2).for_each(|index| assert!(floor.coordinator.set_exploring(id(index), true)));
    let run = |floor: &mut Floor, seconds| floor.run_looking(seconds, |_| false);
    run(&mut floor, 58);
    assert_eq!(floor.coordinator.errand(id(0)), Some(Errand::CutOff));
    assert_eq!(floor.count(Notice::ShutIn), 0);
    run(&mut floor, 60);
    assert_eq!(floor.count(Notice::ShutIn), 1);
    set(&mut floor.fused, walls.iter().map(|it| (*it, Cell::Free)));
    let explores =
        |floor: &mut Floor| matches!(floor.coordinator.errand(id(0)), Some(Errand::Looks(_)));
    assert!(floor.run_looking(10, explores));
    assert_eq!(floor.count(Notice::ShutIn), 1);
}
