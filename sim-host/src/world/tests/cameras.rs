//! Ideal cameras compared with slow ray marching; people and robots in frames.

use std::collections::{BTreeMap, BTreeSet};

use parry2d_f64::glamx::{DVec2, DVec3};
use ubimap_protocol::{tile::Cell, units::RobotId};

use super::{built_in, seconds, small_room, world};
use crate::{
    camera::{Observation, Source},
    world::{FootprintConfig, Scenario, World, ideal_camera::VisibleRobot, route::Body},
};

const ROOM: &str = "
    [[furniture]]
    footprint.box = { centre_m = [2.0, 1.6], size_m = [0.8, 0.5], heading_deg = 20.0 }
    top_m = 0.6
    [[furniture]]
    footprint.box = { centre_m = [2.9, 0.8], size_m = [1.5, 0.8] }
    bottom_m = 0.7
    top_m = 0.75
    [[furniture]]
    footprint.disc = { centre_m = [1.2, 2.4], radius_m = 0.15 }
    top_m = 3.0
    [[cameras]]
    position_m = [0.1, 0.1, 2.7]
    look_at_m = [2.0, 1.5, 0.0]
    range_m = 4.5
";

/// Whether a point is inside the furniture of this test.
fn holds(scenario: &Scenario, point: DVec3) -> bool {
    scenario.furniture.iter().any(|piece| {
        let inside = match &piece.footprint {
            FootprintConfig::Box { centre_m, size_m, heading_deg } => {
                let turn = DVec2::from_angle(-heading_deg.to_radians());
                let offset = turn.rotate(point.truncate() - DVec2::from(*centre_m)).abs();
                offset.x <= size_m[0] / 2.0 && offset.y <= size_m[1] / 2.0
            }
            FootprintConfig::Disc { centre_m, radius_m } => {
                point.truncate().distance(DVec2::from(*centre_m)) <= *radius_m
            }
            FootprintConfig::Polygon { .. } => unreachable!("not in this test"),
        };
        inside && piece.bottom_m <= point.z && point.z <= piece.top_m
    })
}

/// Whether ray marching from the camera to a point meets nothing.
fn is_clear(scenario: &Scenario, from: DVec3, to: DVec3) -> bool {
    let steps = (from.distance(to) / 0.002) as usize;
    (0..steps).all(|step| !holds(scenario, from.lerp(to, step as f64 / steps as f64)))
}

/// Whether a point is in the picture of this test's camera.
fn is_in_picture(scenario: &Scenario, point: DVec3) -> bool {
    let camera = &scenario.cameras[0];
    let eye = DVec3::from(camera.position_m);
    let forward = (DVec3::from(camera.look_at_m.unwrap()) - eye).normalize();
    let right = forward.cross(DVec3::Z).normalize();
    let down = forward.cross(right);
    let way = point - eye;
    let across = |axis: DVec3| (way.dot(axis) / way.dot(forward)).atan().to_degrees().abs();
    way.dot(forward) > 0.0
        && across(right) <= camera.horizontal_fov_deg / 2.0
        && across(down) <= camera.vertical_fov_deg / 2.0
        && way.length() <= camera.range_m
}

#[test]
fn the_visible_floor_is_what_ray_marching_reaches() {
    let scenario = small_room(ROOM);
    let mut world = world(&scenario, 0);
    let eye = DVec3::from(scenario.cameras[0].position_m);
    let camera = world.cameras.cameras().next().unwrap();
    let visible: BTreeMap<(i32, i32), Cell> =
        camera.visible().iter().map(|it| (it.cell, it.state)).collect();
    let (mut free, mut occupied, mut blind) = (0, 0, 0);
    for (x, y) in (0..80).flat_map(|x| (0..60).map(move |y| (x, y))) {
        let centre = (DVec2::new(f64::from(x), f64::from(y)) + 0.5) * 0.05;
        // Cells that furniture only grazes may be either, and are skipped.
        let corners = (-4..=4).flat_map(|dx| (-4..=4).map(move |dy| (dx, dy)));
        let stands = corners
            .map(|(dx, dy)| centre + DVec2::new(f64::from(dx), f64::from(dy)) * 0.0065)
            .filter(|point| (0..6).any(|z| holds(&scenario, point.extend(f64::from(z) * 0.05))))
            .count();
        let floor = centre.extend(0.0);
        if stands == 0 {
            let expected = is_in_picture(&scenario, floor) && is_clear(&scenario, eye, floor);
            assert_eq!(visible.get(&(x, y)) == Some(&Cell::Free), expected, "floor {x}, {y}");
            *(if expected { &mut free } else { &mut blind }) += 1;
        } else if stands == 81 {
            assert_ne!(visible.get(&(x, y)), Some(&Cell::Free), "{x}, {y} is not free");
            // The camera can see the centre of the box's top.
            let top = centre.extend(0.6);
            if holds(&scenario, top) && is_in_picture(&scenario, top) {
                let expected = is_clear(&scenario, eye, top + DVec3::Z * 0.001);
                assert!(!expected || visible.get(&(x, y)) == Some(&Cell::Occupied), "top {x}, {y}");
                occupied += usize::from(expected);
            }
        }
    }
    assert!(free > 500 && occupied > 50 && blind > 500, "{free}, {occupied}, {blind}");
}

#[test]
fn overhangs_hide_cells_but_do_not_occupy_them() {
    let mut world = world(&small_room(ROOM), 0);
    let under_the_board = (64, 16);
    assert!(!world.covered(0).contains(&under_the_board));
    assert!(world.truth().free.contains(&under_the_board));
    // No cell under the board may be occupied.
    let board = |cell: &(i32, i32)| (43..73).contains(&cell.0) && (8..24).contains(&cell.1);
    let visible = world.cameras.cameras().next().unwrap().visible();
    assert!(visible.iter().filter(|it| board(&it.cell)).all(|it| it.state == Cell::Free));
}

/// All observations until a time in seconds.
fn observations(world: &mut World, until: f64) -> Vec<Observation> {
    std::iter::from_fn(|| world.poll(seconds(until))).collect()
}

#[test]
fn a_person_is_movable_and_casts_a_shadow() {
    let empty = small_room(ROOM);
    let mut with_person = small_room(ROOM);
    with_person.people = small_room(
        "[[people]]
        waypoints_m = [[1.0, 1.0]]",
    )
    .people;
    let look = |scenario: &Scenario| observations(&mut world(scenario, 0), 0.2).remove(0);
    let (empty, seen) = (look(&empty), look(&with_person));
    let cells = |it: &Observation| it.cells.iter().copied().collect::<BTreeMap<_, _>>();
    let (without, with) = (cells(&empty), cells(&seen));
    let eye = DVec2::new(0.1, 0.1);
    let mut shadow = 0;
    for (&(x, y), &state) in &without {
        let centre = (DVec2::new(f64::from(x), f64::from(y)) + 0.5) * 0.05;
        let distance = centre.distance(DVec2::new(1.0, 1.0));
        match with.get(&(x, y)) {
            Some(&Cell::Movable) => assert!(distance < 0.2 + 0.04, "{x}, {y}"),
            Some(&now) => assert_eq!(now, state),
            // Not listed: behind the person, or inside.
            None => {
                shadow += 1;
                assert!(centre.distance(eye) > 0.9, "{x}, {y} is in front of the person");
            }
        }
    }
    let movable = with.values().filter(|&&state| state == Cell::Movable).count();
    // A disc of 0.2 m covers fifty cells and touches some more.
    assert!((50..90).contains(&movable), "{movable}");
    let [person] = &seen.things[..] else { panic!("{:?}", seen.things) };
    assert_eq!((person.cells.len(), empty.things.len()), (movable, 0));
    assert!(shadow > 200, "{shadow}");
}

#[test]
fn a_localised_robot_is_no_obstacle_and_a_hidden_one_is_not_localised() {
    let mut scenario = small_room(ROOM);
    scenario.robots = small_room(
        "[[robots]]
        id = 7
        start = { x_m = 1.5, y_m = 1.0, heading_deg = 30.0 }
        [[robots]]
        id = 8
        start = { x_m = 3.2, y_m = 0.8 }",
    )
    .robots;
    let first = observations(&mut world(&scenario, 0), 0.2).remove(0);
    let ids: Vec<RobotId> = first.robots.iter().map(|it| it.robot).collect();
    assert_eq!(ids, [RobotId(7)], "the other is under the board");
    assert_eq!(
        first.robots[0].pose,
        ubimap_protocol::units::Pose::from_metres(1.5, 1.0, 30_f64.to_radians())
    );
    let listed: BTreeSet<(i32, i32)> = first.cells.iter().map(|&(cell, _)| cell).collect();
    for (x, y) in (27..33).flat_map(|x| (17..23).map(move |y| (x, y))) {
        let nearest = DVec2::new(1.5, 1.0).clamp(
            DVec2::new(x as f64, y as f64) * 0.05,
            DVec2::new(x as f64 + 1.0, y as f64 + 1.0) * 0.05,
        );
        if nearest.distance(DVec2::new(1.5, 1.0)) < 0.149 {
            assert!(!listed.contains(&(x, y)), "{x}, {y} is under the robot");
        }
    }
}

#[test]
fn frames_come_at_their_rate_after_their_latency() {
    let mut world = built_in(1);
    let latency = 60_000;
    let mut captured = vec![Vec::new(); world.cameras.cameras().count()];
    let mut with_cells = 0;
    let mut now = seconds(0.0);
    while let Some(next) = world.next_arrival().filter(|&next| next <= seconds(20.0)) {
        assert!(next >= now);
        now = next;
        let observation = world.poll(now).expect("an observation was announced");
        assert_eq!(observation.captured.micros() + latency, now.micros());
        captured[observation.camera].push(observation.captured);
        with_cells += usize::from(!observation.cells.is_empty());
        assert!(observation.cells.iter().all(|&(_, cell)| cell != Cell::Unknown));
        let mut seen = BTreeSet::new();
        assert!(observation.cells.iter().all(|&(cell, _)| seen.insert(cell)), "listed twice");
    }
    for frames in &captured {
        assert!((298..=301).contains(&frames.len()), "{} frames in 20 s", frames.len());
        assert!(frames.is_sorted());
    }
    let expected = 40 * captured.len();
    assert!(with_cells.abs_diff(expected) <= 5, "{with_cells} frames with cells");
}

#[test]
fn shadows_agree_with_ray_marching() {
    let mut low = small_room(ROOM);
    low.cameras[0].position_m[2] = 1.2;
    low.people = small_room(
        "[[people]]
        waypoints_m = [[0.9, 0.6], [1.0, 2.0]]
        [[people]]
        waypoints_m = [[2.9, 2.3]]
        height_m = 1.0",
    )
    .people;
    let mut hidden_cells = 0;
    for scenario in [low, Scenario::built_in().unwrap()] {
        let mut world = world(&scenario, 2);
        for time in [0.0, 4.0, 9.5] {
            world.advance(seconds(time));
            let bodies = world.bodies(None, None);
            let robots: Vec<VisibleRobot> = world.robots().iter().map(VisibleRobot::of).collect();
            let people: Vec<Body> = bodies[robots.len()..].to_vec();
            for camera in world.cameras.cameras() {
                let frame = camera.frame(&world.room, &robots, &people, true);
                let listed: BTreeMap<(i32, i32), Cell> = frame.cells.into_iter().collect();
                let eye = camera.position();
                for seen in camera.visible() {
                    let steps = 1500;
                    let is_hidden = (0..=steps).any(|step| {
                        let point = eye.lerp(seen.target, f64::from(step) / f64::from(steps));
                        bodies.iter().any(|body| {
                            point.z <= body.height
                                && point.truncate().distance(body.centre) <= body.radius
                        })
                    });
                    hidden_cells += usize::from(is_hidden);
                    // Ray marching may miss a grazed edge; a body also hides what it touches.
                    let is_listed = listed.get(&seen.cell) == Some(&seen.state);
                    assert!(!(is_hidden && is_listed), "{:?} is hidden", seen.cell);
                    if !is_hidden && !is_listed {
                        let grazes = bodies.iter().any(|body| {
                            (0..=steps).any(|step| {
                                let part = f64::from(step) / f64::from(steps);
                                let point = eye.lerp(seen.target, part);
                                point.z <= body.height + 0.01
                                    && point.truncate().distance(body.centre) <= body.radius + 0.04
                            })
                        });
                        assert!(grazes, "{:?} is in sight", seen.cell);
                    }
                }
            }
        }
    }
    assert!(hidden_cells > 3000, "{hidden_cells}");
}
