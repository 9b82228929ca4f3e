//! The built-in room has the intended coverage: two cameras leave blind spots, and the robots' routes see
//! into all of them.

use std::collections::BTreeSet;

use libm::{cos, sin};
use parry2d_f64::glamx::DVec2;

use super::{super::room::CellGrid, built_in, seconds};
use crate::{camera::Source, world::Scenario};

#[test]
#[ignore = "long: cargo thorough"]
fn cameras_and_robots_together_see_the_room() {
    let scenario = Scenario::built_in().unwrap();
    let mut world = built_in(1);
    let truth = world.truth().clone();
    let (mut by_cameras, mut by_robots) = (BTreeSet::new(), BTreeSet::new());
    while let Some(scan) = world.poll_scan(seconds(scenario.duration_s)) {
        // An ideal map: the cells that the beams cross from the robot's true pose.
        let sensor = world.robots()[scan.robot].sensor();
        let heading = scan.truth.heading.radians();
        let at = DVec2::new(scan.truth.x.metres(), scan.truth.y.metres());
        let mount = sensor.mount();
        let offset = DVec2::new(mount.x.metres(), mount.y.metres());
        let eye = at + DVec2::new(cos(heading), sin(heading)).rotate(offset);
        for (beam, &reading) in scan.readings_mm.iter().enumerate() {
            let angle = heading + sensor.first_angle_rad() + beam as f64 * sensor.step_rad();
            let along = DVec2::new(cos(angle), sin(angle));
            for step in 0..=(f64::from(reading) / 20.0) as usize {
                by_robots.insert(cell_at(eye + along * (step as f64 * 0.02)));
            }
            if reading > 0 {
                by_robots.insert(cell_at(eye + along * (f64::from(reading) / 1000.0 + 0.002)));
            }
        }
    }
    while let Some(observation) = world.poll(seconds(scenario.duration_s)) {
        by_cameras.extend(observation.cells.iter().map(|&(cell, _)| cell));
    }
    let share = |cells: &[(i32, i32)], of: &dyn Fn(&(i32, i32)) -> bool| {
        cells.iter().filter(|&cell| of(cell)).count() as f64 / cells.len() as f64
    };
    let cameras = share(&truth.free, &|cell| by_cameras.contains(cell));
    let free = share(&truth.free, &|cell| by_cameras.contains(cell) || by_robots.contains(cell));
    let surfaces =
        share(&truth.surfaces, &|cell| by_cameras.contains(cell) || by_robots.contains(cell));
    assert!((0.5..0.8).contains(&cameras), "most of the floor, but not all: {cameras}");
    assert!(free >= 0.99 && surfaces >= 0.97, "{free}, {surfaces}");
}

fn cell_at(point: DVec2) -> (i32, i32) {
    CellGrid { first: (0, 0), columns: 0, rows: 0, side: 0.05 }.cell_at(point)
}
