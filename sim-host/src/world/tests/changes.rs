//! Moved furniture, doors that open and close, and who waits for whom.

use parry2d_f64::glamx::DVec2;

use super::{RESOLUTION, seconds, small_room, world};
use crate::world::World;

#[test]
fn the_truth_shows_furniture_in_its_new_place() {
    let scenario = small_room(
        "[[furniture]]
        footprint.box = { centre_m = [1.025, 1.025], size_m = [0.3, 0.3] }
        top_m = 0.8
        moved = [{ at_s = 2.0, centre_m = [3.025, 2.025] }]",
    );
    let mut world = world(&scenario, 1);
    // The middle of the western side, before and after the move.
    let (before, after) = ((17, 20), (57, 40));
    let is_surface = |world: &World, cell| world.truth().surfaces.contains(&cell);
    assert!(is_surface(&world, before) && !is_surface(&world, after));
    world.advance(seconds(1.99));
    assert!(is_surface(&world, before));
    world.advance(seconds(2.0));
    assert!(!is_surface(&world, before) && is_surface(&world, after));
}

#[test]
fn furniture_waits_until_its_place_is_free() {
    let scenario = small_room(
        "[[robots]]
        id = 1
        start = { x_m = 0.5, y_m = 1.5 }
        route.waypoints_m = [[3.5, 1.5]]
        [[furniture]]
        footprint.box = { centre_m = [2.0, 0.4], size_m = [0.4, 0.4] }
        top_m = 0.8
        moved = [{ at_s = 0.5, centre_m = [0.6, 1.14] }]",
    );
    let mut world = world(&scenario, 1);
    let is_moved = |world: &World| world.room.is_solid(DVec2::new(0.6, 1.14), 0.1, 0.2);
    let mut moved_at = None;
    for step in 0..300 {
        let time = f64::from(step) * 0.01;
        world.advance(seconds(time));
        let body = world.robots()[0].body();
        assert!(world.room.obstacle(body.centre, body.centre, body.radius, 0.3).is_none());
        if is_moved(&world) && moved_at.is_none() {
            moved_at = Some((time, body.centre.x));
        }
    }
    let (time, x) = moved_at.expect("the furniture is moved eventually");
    // As long as the robot has not passed the corner, it is too close.
    assert!(time > 0.5 && x > 0.8, "moved at {time} s with the robot at {x}");
}

const DOOR: &str = "
    [[room.walls]]
    points_m = [[2.0, 0.0], [2.0, 1.0]]
    [[room.walls]]
    points_m = [[2.0, 2.0], [2.0, 3.0]]
    [[doors]]
    hinge_m = [2.0, 1.05]
    heading_deg = 90.0
    swing_deg = 90.0
    open_s = [[6.0, 30.0]]
    [[people]]
    waypoints_m = [[0.6, 1.5], [3.4, 1.5]]
    speed_m_s = 0.7
";

#[test]
fn a_person_waits_at_a_closed_door_and_passes_when_it_opens() {
    let scenario = small_room(DOOR);
    let mut world = world(&scenario, 1);
    let mut passed = None;
    for step in 0..3_000 {
        let time = f64::from(step) * 0.01;
        world.advance(seconds(time));
        let [x, y] = world.people()[0].position_m();
        let within = world.people()[0].radius_m() - 1e-6;
        let at = DVec2::new(x, y);
        assert_eq!(world.room.obstacle(at, at, within, 1.7), None, "at {time} s");
        if x > 2.3 && passed.is_none() {
            passed = Some(time);
        }
    }
    let passed = passed.expect("the person passes the door");
    assert!(passed > 6.0, "passed the closed door at {passed} s");
}

#[test]
fn a_path_through_a_future_place_of_furniture_is_refused() {
    let scenario = small_room(
        "[[robots]]
        id = 1
        start = { x_m = 0.5, y_m = 1.5 }
        route.waypoints_m = [[3.5, 1.5]]
        [[furniture]]
        footprint.box = { centre_m = [2.0, 0.4], size_m = [0.4, 0.4] }
        top_m = 0.8
        moved = [{ at_s = 0.5, centre_m = [2.0, 1.5] }]",
    );
    let error = World::new(&scenario, None, RESOLUTION, 1).err().unwrap().to_string();
    assert!(error.contains("the path touches furniture[0]"), "{error}");
}
