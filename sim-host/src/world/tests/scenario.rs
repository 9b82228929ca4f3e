//! Errors in a scenario are reported in one line that names the file and the key.

use super::RESOLUTION;
use crate::world::{BUILT_IN, NAMED, Scenario, ScenarioError, World};

/// The error for the built-in scenario after replacing the first occurrence of `from` by `to`.
fn complaint(from: &str, to: &str) -> String {
    assert!(BUILT_IN.contains(from), "the built-in scenario has no {from}");
    let text = BUILT_IN.replacen(from, to, 1);
    let world = Scenario::from_toml(&text, "hall.toml")
        .and_then(|scenario| World::new(&scenario, None, RESOLUTION, 1));
    match world {
        Ok(_) => panic!("no error for {to}"),
        Err(error) => error.to_string(),
    }
}

/// The start of the first robot, in the file.
const START: &str = "start = { x_m = 5.6, y_m = 3.4, heading_deg = -90.0 }";
/// The first stops of its route, in the file.
const ROUTE: &str = "[[5.6, 1.6], [7.4, 1.6]";

#[test]
fn more_cameras_than_memory_holds_are_refused() {
    let camera = "[[cameras]]\nposition_m = [1.0, 1.0, 2.5]\nheading_deg = 0.0\ntilt_deg = 60.0\n";
    let text = format!("{BUILT_IN}\n{}", camera.repeat(256));
    let error = Scenario::from_toml(&text, "hall.toml").unwrap_err().to_string();
    assert!(error.contains("; give 256 at most"), "{error}");
}

/// Impossible numbers. Each entry makes one mistake: the text that is replaced, its replacement, and a part
/// of the expected error.
const NUMBERS: &[(&str, &str, &str)] = &[
    ("duration_s = 120.0", "duration_s = nan", "duration_s is NaN"),
    ("duration_s = 120.0", "duration_s = -1.0", "duration_s is -1"),
    ("id = 2", "id = 1", "robots[1].id is 1"),
    ("id = 2", "id = 2\nsensor.rate_hz = 0.0", "robots[1].sensor.rate_hz is 0"),
    ("id = 2", "id = 2\nsensor.beams = 1", "robots[1].sensor.beams is 1"),
    ("id = 2", "id = 2\nsensor.max_range_m = inf", "robots[1].sensor.max_range_m is inf"),
    ("position_noise_m = 0.005", "position_noise_m = -0.1", "cameras[0].position_noise_m is -0.1"),
    ("[[cameras]]", "[[cameras]]\nheading_deg = 0.0", "cameras[0] needs either look_at_m"),
    ("[[cameras]]", "[[cameras]]\nrate_hz = 0.0", "cameras[0].rate_hz is 0"),
    ("height_m = 3.0", "height_m = nan", "room.height_m is NaN"),
    ("[[0.0, 0.0], [10.0, 0.0], [10.0, 8.0], [0.0, 8.0]]", "[]", "room.outline_m needs"),
    ("top_m = 1.9", "top_m = 0.0", "furniture[0].top_m is not above"),
    (
        "[0.05, 7.1], [0.9, 7.95]]",
        "[0.9, 7.95], [0.3, 7.9], [0.05, 7.1]]",
        "furniture[7].footprint.polygon.points_m is not a convex",
    ),
];

/// Occupied or unreachable places.
const PLACES: &[(&str, &str, &str)] = &[
    (
        START,
        "start = { x_m = 6.6, y_m = 0.5 }",
        "robots[0].start overlaps or is too close to room.walls[0]",
    ),
    (
        START,
        "start = { x_m = 2.3, y_m = 1.7 }",
        "robots[0].start overlaps or is too close to furniture[0]",
    ),
    (START, "start = { x_m = 12.0, y_m = 3.0 }", "robots[0].start is outside of the room"),
    (
        START,
        "start = { x_m = 4.4, y_m = 2.7 }",
        "robots[1].start overlaps the body that starts at robots[0].start",
    ),
    (
        ROUTE,
        "[[6.6, 0.5], [7.4, 1.6]",
        "robots[0].route.waypoints_m[0] overlaps or is too close to room.walls[0]",
    ),
    (
        ROUTE,
        "[[5.6, 0.6], [7.4, 0.6]",
        "robots[0].route.waypoints_m[1] can't be reached from robots[0].route.waypoints_m[0]: the path touches room.walls[0]",
    ),
    (ROUTE, "[[5.6, nan], [7.4, 1.6]", "robots[0].route.waypoints_m[0] is NaN"),
    (
        "position_m = [0.2, 4.2, 2.8]",
        "position_m = [-0.2, 4.2, 2.8]",
        "cameras[0].position_m is outside",
    ),
    (
        "position_m = [0.2, 4.2, 2.8]",
        "position_m = [6.9, 4.6, 2.8]",
        "cameras[0].position_m is inside a wall",
    ),
    (
        "[[2.2, 4.9], ",
        "[[0.45, 4.4], ",
        "people[0].waypoints_m[0] overlaps or is too close to furniture[6]",
    ),
];

/// Postures of the first person that don't fit.
const POSTURES: &[(&str, &str, &str)] = &[
    (
        "[[people]]",
        "[[people]]\nposture = \"sitting\"",
        "people[0].waypoints_m must be a single point unless the person stands or rises",
    ),
    (
        "[[people]]",
        "[[people]]\nrises_s = 40.0",
        "people[0].rises_s is for a person who sits or lies",
    ),
    (
        "[[people]]",
        "[[people]]\nposture = \"lying\"\nrises_s = -1.0",
        "people[0].rises_s is -1; give a number from 0 to 86400",
    ),
    ("[[people]]", "[[people]]\nposture = \"kneeling\"", "unknown variant `kneeling`"),
];

/// Texts that are not a scenario.
const WORDS: &[(&str, &str, &str)] = &[
    ("duration_s = 120.0", "duration_s = \"long\"", "line 7: invalid type"),
    ("duration_s = 120.0", "duration_min = 2.0", "line 7: unknown field `duration_min`"),
    ("duration_s = 120.0", "duration_s = ", "line 7: "),
    ("id = 3", "id = 70000", "invalid value"),
];

#[test]
fn every_mistake_is_one_line_with_file_and_key() {
    for &(from, to, expected) in [NUMBERS, PLACES, POSTURES, WORDS].into_iter().flatten() {
        let said = complaint(from, to);
        assert!(said.starts_with("hall.toml"), "{said}");
        assert!(said.contains(expected), "for {to}: {said}");
        assert!(!said.contains('\n'), "{said}");
    }
}

#[test]
fn a_missing_file_is_named_in_the_error() {
    let error = Scenario::read("/nowhere/hall.toml".as_ref()).unwrap_err();
    assert!(matches!(error, ScenarioError::Read { .. }));
    assert!(error.to_string().starts_with("/nowhere/hall.toml: "), "{error}");
}

#[test]
fn a_room_with_too_many_cells_is_refused() {
    let mut scenario = Scenario::built_in().unwrap();
    scenario.room.outline_m = vec![[-9e3, -9e3], [9e3, -9e3], [9e3, 9e3], [-9e3, 9e3]];
    let error = World::new(&scenario, None, RESOLUTION, 1).err().unwrap();
    assert!(error.to_string().contains("make it smaller"), "{error}");
}

#[test]
fn all_built_in_scenarios_are_valid_and_office_asks_for_its_map() {
    for (name, _) in NAMED {
        let scenario = Scenario::read(name.as_ref());
        if name == "office" {
            let error = scenario.unwrap_err().to_string();
            assert!(error.ends_with("with --map, or as room.map"), "{error}");
            continue;
        }
        let world = World::new(&scenario.unwrap(), None, RESOLUTION, 1);
        assert!(world.is_ok(), "{name}: {}", world.err().unwrap());
    }
}
