//! Tests of the simulated room, where possible against slow independent implementations.

mod cameras;
mod changes;
mod coverage;
mod frames;
mod geometry;
mod growth;
mod motion;
mod scenario;
mod sensors;

use ubimap_protocol::{time::Instant, units::Millimetres};

use super::{Scenario, World};

const RESOLUTION: Millimetres = Millimetres(50);

/// The built-in room.
fn built_in(seed: u64) -> World {
    world(&Scenario::built_in().expect("the built-in scenario is valid"), seed)
}

fn world(scenario: &Scenario, seed: u64) -> World {
    World::new(scenario, None, RESOLUTION, seed).expect("the scenario is valid")
}

/// An empty room, 4 x 3 m inside, plus `more`.
fn small_room(more: &str) -> Scenario {
    let text = format!(
        "duration_s = 10.0
        slice_height_m = 0.2
        [room]
        height_m = 3.0
        wall_thickness_m = 0.1
        outline_m = [[-0.05, -0.05], [4.05, -0.05], [4.05, 3.05], [-0.05, 3.05]]
        {more}"
    );
    Scenario::from_toml(&text, "small.toml").expect("the scenario is valid")
}

fn seconds(seconds: f64) -> Instant {
    Instant::from_micros((seconds * 1e6).round() as u64)
}
