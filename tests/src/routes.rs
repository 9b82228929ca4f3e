//! Scripted routes for the robots of `room` and `warehouse`, as a person would choose them. There
//! are three sets for each scenario; the first is the scenario's own. Autonomous robots are
//! compared with them.

use std::fmt::Write;

use ubimap_sim_host::world::NAMED;

/// The stops of each robot after its start.
type Routes = &'static [&'static [[f64; 2]]];

/// A built-in scenario as TOML with the routes of a set; set 0 is the scenario unchanged.
///
/// # Panics
/// If there is no such scenario or set.
pub fn scripted(scenario: &str, set: usize) -> String {
    let text = NAMED.iter().find(|(name, _)| *name == scenario).unwrap().1;
    let sets = if scenario == "room" { &ROOM } else { &WAREHOUSE };
    let Some(set) = set.checked_sub(1) else { return text.into() };
    let mut routes = sets[set].iter();
    text.lines().fold(String::new(), |mut scripted, line| {
        if line.starts_with("route.waypoints_m") {
            let stops = routes.next().expect("a route for each robot");
            writeln!(scripted, "route.waypoints_m = {stops:?}").unwrap();
        } else {
            writeln!(scripted, "{line}").unwrap();
        }
        scripted
    })
}

/// Number of sets for each scenario.
pub const SETS: usize = 3;

/// The sets for `room` except the scenario's own.
const ROOM: [Routes; SETS - 1] = [
    // Each robot takes the shortest route to its nearest blind corner, and then drives along the
    // walls there.
    &[
        &[
            [5.6, 1.6],
            [7.3, 1.6],
            [7.3, 2.8],
            [9.0, 2.8],
            [7.3, 2.6],
            [7.3, 0.6],
            [9.4, 0.6],
            [7.3, 0.6],
            [7.3, 1.6],
            [5.6, 1.6],
        ],
        &[[4.4, 0.9], [0.9, 0.9], [0.6, 2.6], [0.6, 3.2], [3.0, 2.6]],
        &[[1.6, 5.6], [0.6, 5.7], [0.6, 6.6], [1.6, 7.2], [2.9, 7.2], [1.6, 7.0], [1.6, 5.6]],
        &[
            [8.9, 7.1],
            [9.2, 5.0],
            [8.1, 5.0],
            [8.1, 5.7],
            [8.1, 5.0],
            [8.4, 3.75],
            [9.0, 3.75],
            [8.4, 5.0],
            [6.3, 5.2],
        ],
    ],
    // Along the southern wall of the store room first, and through the west from north to south.
    &[
        &[
            [5.6, 1.6],
            [7.3, 1.6],
            [7.3, 0.6],
            [9.4, 0.6],
            [7.4, 0.6],
            [7.4, 2.7],
            [9.0, 2.7],
            [7.4, 2.7],
            [7.3, 1.6],
            [5.6, 1.6],
        ],
        &[[2.8, 3.2], [0.5, 3.2], [0.6, 0.9], [3.8, 0.9], [4.4, 0.9]],
        &[[2.0, 6.0], [1.6, 7.2], [2.9, 7.2], [1.6, 7.0], [0.6, 6.6], [0.6, 5.6], [1.6, 5.6]],
        &[
            [6.3, 7.1],
            [9.2, 7.2],
            [9.2, 5.0],
            [8.1, 5.0],
            [8.1, 5.7],
            [8.1, 5.0],
            [8.4, 3.75],
            [9.0, 3.75],
            [8.4, 5.0],
            [6.3, 5.2],
        ],
    ],
];

/// The sets for `warehouse` except the scenario's own.
const WAREHOUSE: [Routes; SETS - 1] = [
    // Each robot drives to its nearest blind ground: halves of the aisles, corners, ends.
    &[
        &[[1.0, 1.1], [1.0, 3.6], [8.9, 3.6], [1.0, 3.6], [1.0, 1.1]],
        &[[18.6, 1.1], [19.3, 2.0], [18.6, 3.6], [10.2, 3.6], [18.6, 3.6], [18.6, 1.1]],
        &[[1.0, 5.7], [0.5, 4.4], [0.5, 7.2], [1.0, 5.7]],
        &[[18.3, 5.7], [19.2, 5.6], [18.3, 5.0], [18.3, 3.9], [19.3, 4.2], [18.3, 5.0]],
        &[[1.2, 6.3], [1.2, 8.4], [8.9, 8.4], [1.2, 8.4], [1.2, 6.3]],
        &[[18.3, 6.3], [18.3, 8.4], [10.2, 8.4], [18.3, 8.4], [18.3, 6.3]],
        &[[1.0, 10.9], [0.5, 11.4], [1.0, 9.4], [1.0, 10.9]],
        &[[18.3, 10.9], [18.3, 9.4], [19.4, 9.6], [18.3, 9.4], [18.3, 10.9]],
        &[[9.2, 1.0], [10.8, 0.7], [9.7, 2.4], [9.2, 1.0]],
        &[[9.9, 11.0], [8.8, 11.2], [10.8, 11.2], [9.9, 11.0]],
    ],
    // The robots that start in the middle map the aisles, the others the ends.
    &[
        &[[1.0, 1.1], [0.5, 0.6], [1.0, 3.6], [4.5, 3.6], [1.0, 3.6], [1.0, 1.1]],
        &[[18.6, 1.1], [19.3, 0.6], [18.6, 3.6], [14.5, 3.6], [18.6, 3.6], [18.6, 1.1]],
        &[[1.0, 5.7], [0.5, 4.6], [0.5, 6.6], [1.0, 5.7]],
        &[[18.3, 5.7], [19.2, 5.6], [18.3, 5.0], [18.3, 4.2], [18.3, 5.0]],
        &[[1.2, 6.3], [1.2, 8.4], [4.5, 8.4], [1.2, 8.4], [1.2, 6.3]],
        &[[18.3, 6.3], [18.3, 8.4], [14.5, 8.4], [18.3, 8.4], [18.3, 6.3]],
        &[[1.0, 10.9], [0.5, 11.4], [1.0, 9.4], [1.0, 10.9]],
        &[[18.3, 10.9], [18.3, 9.4], [19.4, 9.6], [18.3, 9.4], [18.3, 10.9]],
        &[[9.2, 3.6], [5.0, 3.6], [14.0, 3.6], [9.4, 3.6], [9.2, 1.0], [10.8, 0.7], [9.2, 1.0]],
        &[
            [9.9, 8.4],
            [14.0, 8.4],
            [5.0, 8.4],
            [9.9, 8.4],
            [9.9, 11.0],
            [8.8, 11.2],
            [10.8, 11.2],
            [9.9, 11.0],
        ],
    ],
];
