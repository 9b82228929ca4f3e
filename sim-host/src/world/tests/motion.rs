//! Motion is reproducible, reaches every stop, and is free of collisions.

use parry2d_f64::glamx::DVec2;
use proptest::prelude::*;
use ubimap_protocol::units::Pose;

use super::{super::route::Body, built_in, seconds, small_room, world};
use crate::{
    camera::{Observation, Source},
    world::{OdometryConfig, PostureConfig, STEP, ScanEvent, Scenario, World},
};

/// All scans and observations until a time, polled at an interval (seconds).
fn recorded(world: &mut World, until: f64, interval: f64) -> (Vec<ScanEvent>, Vec<Observation>) {
    let (mut scans, mut frames) = (Vec::new(), Vec::new());
    let mut time = 0.0;
    while time < until {
        time = (time + interval).min(until);
        scans.extend(std::iter::from_fn(|| world.poll_scan(seconds(time))));
        frames.extend(std::iter::from_fn(|| world.poll(seconds(time))));
    }
    (scans, frames)
}

#[test]
fn results_depend_on_the_seed_and_not_on_polling() {
    let run = recorded(&mut built_in(3), 12.0, 12.0);
    assert!(run == recorded(&mut built_in(3), 12.0, 0.0137));
    assert!(run != recorded(&mut built_in(4), 12.0, 12.0));
    assert_eq!(run.0.len(), 4 * 121);
}

#[test]
fn removing_a_robot_does_not_change_the_noise_of_the_others() {
    let mut scenario = Scenario::built_in().unwrap();
    let all = recorded(&mut world(&scenario, 5), 1.0, 1.0).0;
    scenario.robots.remove(0);
    let fewer = recorded(&mut world(&scenario, 5), 1.0, 1.0).0;
    let readings = |scans: &[ScanEvent], robot: usize| -> Vec<Vec<u16>> {
        let scans = scans.iter().filter(|scan| scan.robot == robot);
        scans.map(|scan| scan.readings_mm.clone()).collect()
    };
    assert_eq!(readings(&all, 1), readings(&fewer, 0));
}

#[test]
fn each_robot_has_noise_of_its_own() {
    // Both sensors see the same wall at the same distance.
    let scenario = small_room(
        "[[robots]]
        id = 1
        start = { x_m = 1.2, y_m = 1.5, heading_deg = 90.0 }
        sensor.fov_deg = 40.0
        [[robots]]
        id = 2
        start = { x_m = 2.8, y_m = 1.5, heading_deg = 90.0 }
        sensor.fov_deg = 40.0",
    );
    let mut world = world(&scenario, 1);
    let [first, second] = [(); 2].map(|()| world.poll_scan(seconds(0.0)).unwrap().readings_mm);
    assert_ne!(first, second);
    // More than five standard deviations at 1.8 m.
    let differ = |(a, b): (&u16, &u16)| a.abs_diff(*b) > 55;
    assert!(!first.iter().zip(&second).any(differ), "{first:?} {second:?}");
}

#[test]
#[ignore = "long: cargo thorough"]
fn nobody_runs_into_anything() {
    for seed in 1..=3 {
        let mut world = built_in(seed);
        for step in 0..30_000 {
            world.advance(seconds(step as f64 * 0.01));
            let bodies: Vec<Body> = world.bodies(None, None);
            for (index, body) in bodies.iter().enumerate() {
                assert!(world.room.encloses(body.centre));
                let within = body.radius - 1e-6;
                let met = world.room.obstacle(body.centre, body.centre, within, body.height);
                assert_eq!(met, None, "number {index} at {step} of seed {seed}");
                for other in &bodies[..index] {
                    let apart = other.centre.distance(body.centre) - other.radius - body.radius;
                    assert!(apart > 0.0, "number {index} at {step} of seed {seed}: {apart} m");
                }
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn a_crowd_with_random_routes_never_collides(
        stops in prop::collection::vec([0.3..3.7, 0.3..2.7_f64], 12),
        seed in any::<u64>(),
    ) {
        let mut scenario = small_room(ROBOT);
        scenario.people = small_room(
            "[[people]]
            waypoints_m = [[1.0, 1.0]]",
        )
        .people;
        let (robot, person) = (scenario.robots.remove(0), scenario.people.remove(0));
        // Each starts in a corner or at a side of the room and goes to random places.
        for (index, ([x_m, y_m], ways)) in
            [[0.3, 0.3], [3.7, 0.3], [0.3, 2.7]].into_iter().zip(stops.chunks(2)).enumerate()
        {
            let mut robot = robot.clone();
            (robot.id, robot.start.x_m, robot.start.y_m) = (index as u16, x_m, y_m);
            robot.route.waypoints_m = ways.to_vec();
            // Too fast to stop in time by normal braking.
            robot.route.speed_m_s = 1.2;
            scenario.robots.push(robot);
        }
        for (start, ways) in
            [[3.7, 2.7], [2.0, 0.3], [2.0, 2.7]].into_iter().zip(stops.chunks(2).skip(3))
        {
            let mut person = person.clone();
            person.waypoints_m = [&[start], ways].concat();
            scenario.people.push(person);
        }
        let mut world = world(&scenario, seed);
        for step in 0..4_000 {
            world.advance(seconds(f64::from(step) * 0.01));
            let bodies = world.bodies(None, None);
            for (index, body) in bodies.iter().enumerate() {
                for other in &bodies[..index] {
                    let apart = other.centre.distance(body.centre) - other.radius - body.radius;
                    prop_assert!(apart > 0.0, "number {index} at {step}: {apart} m");
                }
            }
        }
    }
}

#[test]
fn robots_keep_their_speed_limits_and_reach_every_stop() {
    let scenario = Scenario::built_in().unwrap();
    let mut world = world(&scenario, 1);
    let mut missing: Vec<Vec<DVec2>> = scenario
        .robots
        .iter()
        .map(|robot| robot.route.waypoints_m.iter().map(|&stop| stop.into()).collect())
        .collect();
    let mut before: Vec<_> = world.robots().iter().map(|robot| robot.pose()).collect();
    for step in 1..12_000_u64 {
        world.advance(seconds(step as f64 * 0.01));
        for (index, robot) in world.robots().iter().enumerate() {
            let pose = robot.pose();
            missing[index].retain(|stop| stop.distance(pose.position) > 0.005);
            let route = &scenario.robots[index].route;
            let seconds = STEP.micros() as f64 / 1e6;
            let way = pose.position.distance(before[index].position);
            assert!(way <= route.speed_m_s * seconds + 1e-9);
            let turned = (pose.heading - before[index].heading).sin().asin().abs();
            assert!(turned <= route.turn_rate_deg_s.to_radians() * seconds + 1e-9);
            assert!(way == 0.0 || turned == 0.0, "robot moves and turns at the same time");
            before[index] = pose;
        }
    }
    assert!(missing.iter().all(Vec::is_empty), "stops not reached in two minutes: {missing:?}");
}

const ROBOT: &str = "
    [[robots]]
    id = 1
    start = { x_m = 1.0, y_m = 0.5, heading_deg = 90.0 }
    route.waypoints_m = [[3.0, 0.5], [3.0, 2.5]]
    sensor.noise_m = 0.0
    sensor.noise_ratio = 0.0
";

/// The robot's true pose in the frame of its odometry.
fn from_start(world: &World) -> (DVec2, f64) {
    let pose = world.robots()[0].pose();
    let offset = pose.position - DVec2::new(1.0, 0.5);
    (DVec2::new(offset.y, -offset.x), pose.heading - std::f64::consts::FRAC_PI_2)
}

#[test]
fn odometry_without_errors_is_exact_and_slip_stretches_it() {
    let mut scenario = small_room(ROBOT);
    scenario.robots[0].odometry = OdometryConfig {
        slip: Some(0.0),
        turn_slip: Some(0.0),
        drift_deg_per_m: Some(0.0),
        noise_m: 0.0,
        heading_noise_deg: 0.0,
    };
    let mut exact = world(&scenario, 1);
    scenario.robots[0].odometry.slip = Some(0.02);
    let mut slipping = world(&scenario, 1);
    for step in 0..100 {
        exact.advance(seconds(f64::from(step) * 0.2));
        slipping.advance(seconds(f64::from(step) * 0.2));
        let (offset, heading) = from_start(&exact);
        let expected = Pose::from_metres(offset.x, offset.y, heading);
        let odometry = exact.robots()[0].odometry();
        assert!((odometry.x - expected.x).0.abs() <= 1 && (odometry.y - expected.y).0.abs() <= 1);
        assert!(odometry.heading.distance(expected.heading) <= 2);
        let stretched = Pose::from_metres(offset.x * 1.02, offset.y * 1.02, heading);
        let odometry = slipping.robots()[0].odometry();
        assert!((odometry.x - stretched.x).0.abs() <= 1 && (odometry.y - stretched.y).0.abs() <= 1);
    }
}

#[test]
fn a_scan_without_noise_measures_walls_and_people() {
    let mut scenario = small_room(ROBOT);
    scenario.robots[0].route.waypoints_m.clear();
    let empty = world(&scenario, 1).poll_scan(seconds(0.0)).unwrap();
    let mut with_person = scenario.clone();
    with_person.people = small_room(
        "[[people]]
        waypoints_m = [[1.0, 2.0]]",
    )
    .people;
    let person = world(&with_person, 1).poll_scan(seconds(0.0)).unwrap();
    let sensor = world(&scenario, 1).robots()[0].sensor().clone();
    // The sensor is 0.1 m ahead of the robot, which faces north.
    let eye = DVec2::new(1.0, 0.6);
    let mut nearer = 0;
    for beam in 0..sensor.beams() {
        let angle = std::f64::consts::FRAC_PI_2
            + sensor.first_angle_rad()
            + beam as f64 * sensor.step_rad();
        let (sine, cosine) = angle.sin_cos();
        let to_side = if cosine > 0.0 { (4.0 - eye.x) / cosine } else { -eye.x / cosine };
        let range = to_side.min((3.0 - eye.y) / sine);
        let expected = if range > 4.0 { 0 } else { (range * 1000.0).round() as i32 };
        assert!((i32::from(empty.readings_mm[beam]) - expected).abs() <= 1, "beam {beam}");

        let offset = DVec2::new(1.0, 2.0) - eye;
        let (along, aside) =
            (offset.dot(DVec2::new(cosine, sine)), offset.perp_dot(DVec2::new(cosine, sine)));
        let expected = if aside.abs() < 0.2 {
            nearer += 1;
            ((along - (0.04 - aside * aside).sqrt()) * 1000.0).round() as i32
        } else {
            i32::from(empty.readings_mm[beam])
        };
        assert!((i32::from(person.readings_mm[beam]) - expected).abs() <= 1, "beam {beam}");
    }
    assert!(nearer > 10);
}

#[test]
fn two_robots_that_meet_head_on_resolve_it() {
    let mut scenario = small_room(
        "[[robots]]
        id = 1
        start = { x_m = 0.5, y_m = 1.5 }
        route.waypoints_m = [[3.5, 1.5]]
        [[robots]]
        id = 2
        start = { x_m = 3.5, y_m = 1.5 }
        route.waypoints_m = [[0.5, 1.5]]",
    );
    scenario.robots[1].start.x_m = 3.0;
    let mut world = world(&scenario, 1);
    let mut last_moved = [0.0; 2];
    let mut before: Vec<DVec2> = world.robots().iter().map(|robot| robot.pose().position).collect();
    for step in 0..20_000 {
        let time = f64::from(step) * 0.01;
        world.advance(seconds(time));
        for (index, robot) in world.robots().iter().enumerate() {
            if robot.pose().position != before[index] {
                last_moved[index] = time;
            }
            before[index] = robot.pose().position;
            assert!(
                time - last_moved[index] < 30.0,
                "robot {index} has not moved since {last_moved:?}"
            );
        }
        assert!(before[0].distance(before[1]) > 0.3);
    }
}

#[test]
fn a_person_who_sits_rises_at_the_time_and_walks() {
    let mut world = world(
        &small_room(
            "[[people]]
            waypoints_m = [[1.0, 1.5], [3.0, 1.5]]
            speed_m_s = 1.0
            posture = \"sitting\"
            rises_s = 5.0",
        ),
        1,
    );
    let mut person = |time: f64| {
        world.advance(seconds(time));
        let person = &world.people()[0];
        (person.posture(), person.position_m(), person.height_m())
    };
    let sits = (PostureConfig::Sitting, [1.0, 1.5], 1.36);
    for (time, (posture, [x, y], height)) in [
        (0.0, sits),
        (4.9, sits),
        (5.5, (PostureConfig::Standing, [1.5, 1.5], 1.75)),
        (6.5, (PostureConfig::Standing, [2.5, 1.5], 1.75)),
    ] {
        let found = person(time);
        assert_eq!(found.0, posture, "at {time} s");
        assert!((found.1[0] - x).hypot(found.1[1] - y) < 0.05, "{found:?} at {time} s");
        assert!((found.2 - height).abs() < 0.01, "{found:?} at {time} s");
    }
}
