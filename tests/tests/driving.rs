//! Robots that drive themselves under the server's coordination: they map what no camera sees and
//! run into nothing, with the link cut meanwhile.

use std::{fs, path::Path};

use clap::Parser;
use ubimap_protocol::time::Instant;
use ubimap_sim_host::{
    report::Report,
    run::{
        options::SimulateOptions,
        simulate::{self, RESOLUTION},
    },
    world::{Contacts, Scenario, World},
};

/// Two rooms with a door; the camera sees the first of them. A person walks in it.
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

/// Runs a scenario with options of the command line.
fn driven(name: &str, scenario: &str, options: &[&str]) -> Report {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    fs::write(&path, scenario).unwrap();
    let fixed = ["simulate", path.to_str().unwrap(), "--drive", "--ideal-cameras", "--json"];
    let command_line = CommandLine::parse_from(fixed.iter().chain(options));
    simulate::run(&command_line.options).unwrap().report
}

#[test]
fn two_robots_map_a_room_that_no_camera_sees_with_the_link_cut_meanwhile() {
    let report = driven("two_rooms.toml", TWO_ROOMS, &["--cut", "15", "--latency", "10"]);
    let driving = report.driving.unwrap();
    assert_eq!((driving.collisions, driving.touches), (0, 0), "{report}");
    assert!(driving.blind_m2 > 8.0 && driving.blind_mapped >= 0.99, "{report}");
    assert!(report.map.converged, "{report}");
    assert!(report.robots.iter().all(|robot| robot.frames_lost > 50), "the link was cut");
}

/// The oracle of the other tests: what drives against something is stopped, and counted once.
#[test]
fn who_drives_against_a_wall_or_a_robot_is_stopped_and_counted_once() {
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
    // To the south: the wall is 1.2 m away.
    let quarter = core::f64::consts::FRAC_PI_4;
    let (contacts, pose, radius) = run(-quarter, 20.0);
    assert_eq!(contacts, Contacts { collisions: 1, touches: 0 });
    assert!((pose.y.metres() - radius).abs() < 0.15 && pose.y.metres() >= radius, "{pose:?}");
    // To the north: the other robot is 1.6 m away.
    let (contacts, pose, radius) = run(quarter, 20.0);
    assert_eq!(contacts, Contacts { collisions: 1, touches: 0 });
    let apart = 2.8 - pose.y.metres();
    assert!(apart >= 2.0 * radius - 1e-3 && apart < 2.0 * radius + 0.05, "{apart}");
}
