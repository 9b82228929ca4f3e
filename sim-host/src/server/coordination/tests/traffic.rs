//! Drives of robots whose routes meet.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::{
    floor::{Floor, id},
    plan::Plan,
};
use crate::server::coordination::{Errand, GoalError, Notice, ground::Point};

/// Two rooms, 10 m by 6 m together, with a door of 0.9 m between them.
fn two_rooms() -> Plan {
    let mut plan = Plan::room(10.0, 6.0);
    plan.wall(4.95, 0.0, 5.05, 2.5);
    plan.wall(4.95, 3.4, 5.05, 6.0);
    plan
}

const WEST: [f64; 4] = [0.0, 0.0, 4.5, 6.0];
const EAST: [f64; 4] = [5.5, 0.0, 10.0, 6.0];

/// Where in the other room the goals of each room's robots are.
#[derive(Clone, Copy, Debug)]
enum Goals {
    /// Anywhere.
    Anywhere,
    /// The start of a robot of the other room.
    Exchange,
}

/// Five robots in each room, each with a goal in the other one.
fn crossing(seed: u64, kind: Goals) -> Floor {
    let plan = two_rooms();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut places = |others: &mut Vec<Point>, room| {
        for _ in 0..5 {
            let place = Floor::free_place(&plan, &mut rng, room, others);
            others.push(place);
        }
    };
    let (mut starts, mut goals) = (Vec::new(), Vec::new());
    places(&mut starts, WEST);
    places(&mut starts, EAST);
    match kind {
        Goals::Anywhere => {
            places(&mut goals, EAST);
            places(&mut goals, WEST);
        }
        Goals::Exchange => {
            goals.extend_from_slice(&starts[5..]);
            goals.extend_from_slice(&starts[..5]);
        }
    }
    let mut floor = Floor::new(plan, &starts, seed, |_| false);
    for (index, goal) in goals.iter().enumerate() {
        floor.coordinator.goal(id(index), goal.x, goal.y, floor.now).unwrap();
    }
    floor
}

fn cross(seeds: core::ops::Range<u64>, kind: Goals) {
    let count = seeds.end - seeds.start;
    let (mut times, mut arrived, mut overlaps, mut collisions) = (Vec::new(), 0, 0, 0);
    let mut slowest = std::time::Duration::ZERO;
    for seed in seeds {
        let mut floor = crossing(seed, kind);
        floor.run(900, |floor| floor.count(Notice::Reached) == 10);
        if floor.count(Notice::Reached) < 10 {
            println!(
                "seed {seed}: {} arrived, {:#?}",
                floor.count(Notice::Reached),
                floor.coordinator
            );
        }
        arrived += floor.count(Notice::Reached);
        overlaps += floor.overlaps;
        collisions += floor.collisions;
        times.push(floor.now.micros() / 1_000_000);
        slowest = slowest.max(floor.slowest_tick);
    }
    times.sort_unstable();
    println!(
        "{count} seeds of ten robots through one door, {kind:?}: {arrived} of {} arrived, {overlaps} overlaps, \
         {collisions} collisions; all there after {} s in the median, {} s at most; slowest tick {slowest:?}",
        count * 10,
        times[times.len() / 2],
        times[times.len() - 1],
    );
    assert_eq!((arrived as u64, overlaps, collisions), (count * 10, 0, 0));
}

#[test]
#[ignore = "long: cargo thorough"]
fn ten_robots_pass_one_door_from_both_sides() {
    cross(0..10, Goals::Anywhere);
}

/// There is no order in which each robot can drive its whole route at once, so they must make way.
#[test]
fn robots_of_two_rooms_change_places_through_one_door() {
    cross(0..5, Goals::Exchange);
}

#[test]
#[ignore = "a hundred seeds: for a release build"]
fn ten_robots_pass_one_door_from_both_sides_in_a_hundred_seeds() {
    cross(0..100, Goals::Anywhere);
    cross(0..100, Goals::Exchange);
}

#[test]
fn the_coordinator_is_deterministic() {
    let run = || {
        let mut floor = crossing(3, Goals::Anywhere);
        floor.run(40, |_| false);
        let places: Vec<Point> = floor.bodies.iter().map(|body| body.place).collect();
        (floor.paths, places)
    };
    assert_eq!(run(), run());
}

#[test]
fn robots_wait_for_a_person_in_the_door() {
    let mut floor = Floor::new(two_rooms(), &[Point::new(2.0, 3.0)], 1, |_| false);
    floor.coordinator.goal(id(0), 8.0, 3.0, floor.now).unwrap();
    floor.people = vec![(Point::new(5.0, 2.95), 0.0)];
    floor.run(10, |_| false);
    assert!(floor.bodies[0].place.x < 4.5, "{}", floor.bodies[0].place);
    floor.people.clear();
    let left = floor.now;
    assert!(floor.run(60, |floor| floor.count(Notice::Reached) == 1));
    println!("arrived {:?} after the person left", floor.now.since(left));
    assert!(!floor.is_blocked());
    assert_eq!(floor.count(Notice::NoWay), 0);
}

/// A person steps in front of a robot that already has its path.
#[test]
fn a_robot_held_up_by_a_person_goes_around() {
    let plan = Plan::room(8.0, 5.0);
    let mut floor = Floor::new(plan, &[Point::new(1.0, 2.5)], 1, |_| false);
    floor.coordinator.goal(id(0), 7.0, 2.5, floor.now).unwrap();
    assert!(floor.run(20, |floor| floor.bodies[0].place.x > 2.0));
    floor.people = vec![(Point::new(3.0, 2.5), 0.0)];
    assert!(floor.run(60, |floor| floor.count(Notice::Reached) == 1), "{}", floor.bodies[0].place);
    println!("{:.1} m driven, {:?}", floor.bodies[0].driven, floor.notices);
    assert!(floor.bodies[0].driven < 10.0);
}

#[test]
fn a_dead_robot_in_the_door_causes_one_notice_per_robot() {
    let starts = [Point::new(4.0, 2.95), Point::new(2.0, 2.0), Point::new(2.0, 4.0)];
    let mut floor = Floor::new(two_rooms(), &starts, 1, |_| false);
    for (index, y) in [3.0, 2.0, 4.0].into_iter().enumerate() {
        floor.coordinator.goal(id(index), 8.0, y, floor.now).unwrap();
    }
    assert!(floor.run(60, |floor| floor.bodies[0].place.x > 4.9));
    floor.bodies[0].obeys = false;
    assert!(!floor.run(120, |floor| floor.count(Notice::Reached) > 0));
    assert_eq!(floor.count(Notice::NoWay), 2, "{:?}", floor.notices);
    // The robot comes back, and all continue.
    floor.bodies[0].obeys = true;
    assert!(floor.run(120, |floor| floor.count(Notice::Reached) == 3), "{:?}", floor.notices);
    assert!(!floor.is_blocked());
    assert_eq!(floor.count(Notice::NoWay), 2);
}

/// As when the server was killed while they drove: closer than they are let come.
#[test]
fn robots_that_have_stopped_close_together_reach_their_goals() {
    for (x, y) in [(0.58, 0.0), (0.0, 0.6), (0.45, 0.4), (-0.6, 0.1)] {
        let starts = [Point::new(4.0, 2.5), Point::new(4.0 + x, 2.5 + y)];
        let mut floor = Floor::new(Plan::room(8.0, 5.0), &starts, 1, |_| false);
        floor.coordinator.goal(id(0), 1.0, 2.5, floor.now).unwrap();
        floor.coordinator.goal(id(1), 1.0, 4.0, floor.now).unwrap();
        let arrive = |floor: &mut Floor| floor.count(Notice::Reached) == 2;
        assert!(floor.run(60, arrive), "{x} {y}: {:?}", floor.notices);
        assert_eq!(floor.collisions, 0);
    }
}

/// A robot that a user has stopped is not sent aside, and forgets its goal.
#[test]
fn a_stopped_robot_stays_where_it_is() {
    let mut plan = Plan::room(12.0, 3.0);
    plan.wall(0.0, 1.0, 9.0, 3.0);
    plan.wall(10.2, 1.0, 12.0, 3.0);
    let starts = [Point::new(6.0, 0.5), Point::new(8.0, 0.5)];
    let mut floor = Floor::new(plan, &starts, 1, |_| false);
    floor.coordinator.goal(id(0), 11.0, 0.5, floor.now).unwrap();
    floor.coordinator.goal(id(1), 10.0, 0.5, floor.now).unwrap();
    floor.bodies[1].obeys = false;
    floor.coordinator.end_errand(id(1));
    assert!(!floor.run(60, |floor| floor.count(Notice::Reached) > 0));
    assert_eq!(floor.bodies[1].place, starts[1]);
    assert_eq!(floor.coordinator.errand(id(1)), Some(Errand::Idle));
    assert_eq!(floor.count(Notice::NoWay), 1);
    // It may drive again, and makes way.
    floor.bodies[1].obeys = true;
    assert!(floor.run(240, |floor| floor.count(Notice::Reached) == 1), "{:?}", floor.notices);
    assert_ne!(floor.bodies[1].place, starts[1]);
}

/// A corridor 1 m wide with a niche; each robot's goal is the other one's start.
#[test]
fn a_robot_makes_way_in_a_niche_of_a_corridor() {
    let mut plan = Plan::room(12.0, 3.0);
    plan.wall(0.0, 1.0, 3.0, 3.0);
    plan.wall(4.2, 1.0, 12.0, 3.0);
    let starts = [Point::new(6.0, 0.5), Point::new(8.0, 0.5), Point::new(9.0, 0.5)];
    let mut floor = Floor::new(plan, &starts, 1, |_| false);
    floor.coordinator.goal(id(0), 11.0, 0.5, floor.now).unwrap();
    floor.coordinator.goal(id(1), 1.0, 0.5, floor.now).unwrap();
    assert!(floor.run(240, |floor| floor.count(Notice::Reached) == 2), "{:?}", floor.notices);
    println!("passed each other after {} s", floor.now.micros() / 1_000_000);
    assert!(!floor.is_blocked());
}

#[test]
fn an_impossible_goal_is_refused_with_one_notice() {
    let mut plan = two_rooms();
    plan.wall(4.95, 2.5, 5.05, 3.4);
    let mut floor = Floor::new(plan, &[Point::new(2.0, 3.0)], 1, |place| place.x > 9.0);
    let now = floor.now;
    let refused = [
        (8.0, 3.0, GoalError::Unreachable),
        (5.0, 1.0, GoalError::Occupied),
        (0.1, 1.0, GoalError::Occupied),
        (9.5, 3.0, GoalError::UnknownGround),
        (40.0, 3.0, GoalError::OutsideMap),
        (f64::NAN, f64::INFINITY, GoalError::OutsideMap),
    ];
    for (x, y, error) in refused {
        assert_eq!(floor.coordinator.goal(id(0), x, y, now), Err(error), "{x}, {y}");
    }
    assert_eq!(floor.coordinator.goal(id(7), 2.0, 2.0, now), Err(GoalError::UnknownRobot(id(7))));
    floor.run(5, |_| false);
    assert_eq!(floor.notices.len(), refused.len() + 1);
    assert_eq!(floor.paths, 0);
}

/// Measures the duration of a tick of ten robots in a hall of 20 m by 15 m.
#[test]
#[ignore = "a measurement: for a release build"]
fn the_time_of_a_tick() {
    let mut plan = Plan::room(20.0, 15.0);
    for column in 0..4 {
        for row in 0..3 {
            let (x, y) = (3.0 + f64::from(column) * 4.0, 2.0 + f64::from(row) * 4.5);
            plan.wall(x, y, x + 1.2, y + 2.5);
        }
    }
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut starts = Vec::new();
    for _ in 0..10 {
        let place = Floor::free_place(&plan, &mut rng, [0.0, 0.0, 20.0, 15.0], &starts);
        starts.push(place);
    }
    // Runs the same ticks several times. The minimum duration of each tick is the least affected by
    // other load.
    let mut least: Vec<std::time::Duration> = Vec::new();
    for _ in 0..5 {
        let mut floor = Floor::new(plan.clone(), &starts, 1, |place| place.x > 10.0);
        for index in 0..10 {
            floor.coordinator.set_exploring(id(index), true);
        }
        let mut ticks = Vec::new();
        floor.run_looking(90, |floor| {
            if let Some(tick) = floor.last_tick.take() {
                ticks.push(tick);
            }
            false
        });
        least.resize(ticks.len(), std::time::Duration::MAX);
        least.iter_mut().zip(ticks).for_each(|(least, tick)| *least = tick.min(*least));
    }
    least.sort_unstable();
    println!(
        "a tick of ten exploring robots: {:?} in the median, {:?} in 95 of 100, {:?} at most",
        least[least.len() / 2],
        least[least.len() * 95 / 100],
        least[least.len() - 1],
    );
}
