//! Scenarios generated from a map: every robot and person stands on free floor and can reach its
//! stops.

use super::{RESOLUTION, seconds};
use crate::{
    testing::Folder,
    world::{Scenario, SensorPreset, WallGrid, World},
};

/// Two rooms of 6 x 5 m with a door of 1.2 m between them, and an inaccessible third.
fn rooms() -> (WallGrid, Vec<bool>) {
    let (width, height) = (200, 100);
    let mut occupied = vec![false; width * height];
    for row in 0..height {
        for column in 0..width {
            let is_wall =
                [0, 65, 130, width - 1].contains(&column) || [0, height - 1].contains(&row);
            let is_door = column == 65 && (40..64).contains(&row);
            occupied[row * width + column] = is_wall && !is_door;
        }
    }
    let free = occupied.iter().map(|occupied| !occupied).collect();
    let grid = WallGrid { resolution_m: 0.05, origin_m: [-3.0, -2.0], width, height, occupied };
    (grid, free)
}

fn office() -> Scenario {
    Scenario::read_with("office".as_ref(), Some("office.yaml".as_ref())).unwrap()
}

#[test]
fn cameras_robots_and_people_are_placed_in_both_rooms() {
    let (grid, free) = rooms();
    let mut scenario = office();
    scenario.grow_in(&grid, &free).unwrap();
    assert_eq!((scenario.cameras.len(), scenario.robots.len(), scenario.people.len()), (8, 4, 2));
    // `World::new` refuses places and paths that are not free.
    let mut world = World::new(&scenario, Some(&grid), RESOLUTION, 1).unwrap();
    let column = |x: f64| (x + 3.0) / 0.05;
    let in_west = |x: f64| column(x) < 65.0;
    assert!(scenario.cameras.iter().all(|camera| column(camera.position_m[0]) < 130.0));
    assert!(scenario.cameras.iter().any(|camera| in_west(camera.position_m[0])));
    assert!(scenario.cameras.iter().any(|camera| !in_west(camera.position_m[0])));
    // A robot or person moves from one room to the other.
    let side = |world: &World| -> Vec<bool> {
        world.robots().iter().map(|robot| in_west(robot.truth().x.metres())).collect()
    };
    let before = side(&world);
    let crosses = (0..90).any(|second| {
        world.advance(seconds(f64::from(second)));
        side(&world) != before
    });
    assert!(crosses);
}

#[test]
fn a_map_with_too_little_room_reports_the_number_of_places() {
    let (mut grid, mut free) = rooms();
    // Fill everything except a corner of two metres.
    for (index, occupied) in grid.occupied.iter_mut().enumerate() {
        *occupied |= index % 200 > 40 || index / 200 > 40;
        free[index] &= !*occupied;
    }
    let error = office().grow_in(&grid, &free).unwrap_err().to_string();
    assert!(error.contains("grow has free floor for only"), "{error}");
}

#[test]
fn grown_robots_have_the_sensor_that_was_asked_for() {
    let (grid, free) = rooms();
    let text = include_str!("../../../scenarios/office.toml");
    let text = text.replace("people = 2", "people = 0\nsensor = { preset = \"depth_row\" }");
    let folder = Folder::new("grown-sensor");
    let file = folder.file("scenario.toml", text.as_bytes());
    let mut scenario = Scenario::read_with(&file, Some("office.yaml".as_ref())).unwrap();
    scenario.grow_in(&grid, &free).unwrap();
    let preset = SensorPreset::DepthRow;
    assert!(scenario.robots.iter().all(|robot| robot.sensor.preset == preset));
    assert_eq!(scenario.robots.len(), 4);
}
