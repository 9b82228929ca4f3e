//! Another robot on the map: without a mask, with a square around it (Ahmed 2.2), and with its
//! footprint as a mask. A square that is computed as if the robot's length were equal to its width
//! reproduces Ahmed's errors (his figures 5 and 6): ends of robots are mapped as walls.

use std::collections::{BTreeSet, VecDeque};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{Bounds, Config, Memory, map::PeerMask, sense::SensorModel};
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    channel::fault::Faults,
    deployment::{
        self,
        registry::{RegisteredRobot, Registry},
    },
    run::fleet::{Event, Fleet},
    run::heap::BOUNDS,
};
use ubimap_tests::{deployments::deployed, script::Script};

/// Beams of a half circle.
const BEAMS: usize = 181;
/// Half the sides of a room of 6 by 4 m around the origin.
const ROOM: [f64; 2] = [3.0, 2.0];
/// Half the length and width of the other robot.
const BODY: [f64; 2] = [0.6, 0.15];
/// Duration of a run.
const SECONDS: u64 = 12;

/// The other robot's pose after some seconds.
type Way = fn(f64) -> [f64; 3];

const SCENES: [(&str, Way); 4] = [
    ("standing 35 cm off a wall", |_| [0.6, 1.5, 0.0]),
    ("standing 65 cm off a wall", |_| [0.6, 1.2, 0.0]),
    ("turning on the spot", |seconds| [0.6, 1.1, 0.5 * seconds]),
    ("driving along a wall", |seconds| [-0.8 + 0.2 * seconds, 1.3, 0.0]),
];

#[derive(Clone, Copy, Debug, PartialEq)]
enum Told {
    Nothing,
    /// The mask of a robot whose length is taken to be equal to its width.
    Short(PeerMask),
    Of(PeerMask),
}

/// The cells that the robot reported as occupied at any time.
struct Drawn {
    /// Occupied cells where there is no wall.
    wrong: BTreeSet<(i32, i32)>,
    walls: BTreeSet<(i32, i32)>,
}

/// Distance to the walls or to the other robot, along a unit vector.
fn range(from: [f64; 2], way: [f64; 2], body: [f64; 3]) -> f64 {
    let walls = (0..2).map(|axis| (ROOM[axis] * way[axis].signum() - from[axis]) / way[axis]);
    let wall = walls.fold(f64::INFINITY, f64::min);
    let (sin, cos) = body[2].sin_cos();
    let turned = |[x, y]: [f64; 2]| [x * cos + y * sin, y * cos - x * sin];
    let (from, way) = (turned([from[0] - body[0], from[1] - body[1]]), turned(way));
    let (mut enter, mut leave) = (0.0f64, wall);
    for axis in 0..2 {
        let to = |side: f64| (side - from[axis]) / way[axis];
        let (a, b) = (to(BODY[axis]), to(-BODY[axis]));
        (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
    }
    if enter < leave { enter } else { wall }
}

/// A robot maps the room while another one is in it; cameras see both, but none of the room.
fn run(way: Way, told: Told) -> Drawn {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let step = std::f64::consts::PI / (BEAMS - 1) as f64;
    let first = -std::f64::consts::FRAC_PI_2;
    let sensor = SensorModel::Radial { first: first as f32, step: step as f32 };
    let bounds = Bounds { readings: BEAMS, ..BOUNDS };
    let mut config = Config::new(RobotId(1), sensor, bounds).with_drive(None);
    if let Told::Of(mask) | Told::Short(mask) = told {
        config.peer_mask = mask;
    }
    let mut events = VecDeque::new();
    for millis in (0..SECONDS * 1_000).step_by(10) {
        let now = Instant(millis * 1_000);
        let seconds = millis as f64 / 1_000.0;
        // The robot moves back and forth, and faces the other robot.
        let at = [-1.2 + 0.3 * seconds.sin(), -0.6];
        let body = way(seconds);
        if millis % 70 == 0 {
            let mut noisy = |[x, y, heading]: [f64; 3]| {
                let mut off = |most: f64| rng.random_range(-most..most);
                Pose::from_metres(x + off(0.02), y + off(0.02), heading + off(0.02))
            };
            let mut robots = vec![Sighting::usual(RobotId(1), noisy([at[0], at[1], 0.6]))];
            let other = Sighting::usual(RobotId(2), noisy(body));
            robots.extend((told != Told::Nothing).then_some(other));
            let observation = Observation { captured: now, robots, ..Observation::default() };
            events.push_back((now, Event::Observation(observation)));
        }
        // The clocks are synchronised by then.
        if millis % 100 == 50 && seconds > 3.0 {
            let readings = (0..BEAMS).map(|beam| {
                let bearing = 0.6 + first + beam as f64 * step;
                let range = range(at, [bearing.cos(), bearing.sin()], body);
                (range * 1_000.0 * rng.random_range(0.99..1.01)) as u16
            });
            events.push_back((now, Event::Scan { robot: 0, readings: readings.collect() }));
        }
    }
    let mut memory = [Memory::new(&bounds)];
    let faults = Faults { latency: Duration::from_millis(30), ..Faults::default() };
    let [mut length_m, width_m] = BODY.map(|half| 2.0 * half);
    if matches!(told, Told::Short(_)) {
        length_m = width_m;
    }
    let other = RegisteredRobot::new(2, 0.1, 0.3, [length_m, width_m]);
    let registry = Registry { robots: vec![other] };
    let deployment =
        deployment::Config { registry, ..deployment::Config::new(config.bounds.resolution) };
    let mut fleet = Fleet::new(&[config], &mut memory, faults, 1, deployed(deployment)).unwrap();

    let mut drawn = Drawn { wrong: BTreeSet::new(), walls: BTreeSet::new() };
    let side = config.bounds.resolution.metres();
    let converged = fleet.run(&mut Script(events), |fleet| {
        for tile in fleet.robots()[0].robot().own_tiles().tiles() {
            let (x0, y0) = tile.id().unwrap().first_cell();
            let cells = (0..TILE_SIDE).flat_map(|y| (0..TILE_SIDE).map(move |x| (x, y)));
            for (x, y) in cells {
                if !matches!(tile.publication().sent().cell(x, y), Cell::Occupied | Cell::Movable) {
                    continue;
                }
                let cell = (x0 + x as i32, y0 + y as i32);
                let middle = [cell.0, cell.1].map(|cell| (f64::from(cell) + 0.5) * side);
                let off = (0..2).map(|axis| ROOM[axis] - middle[axis].abs());
                // The tolerance covers the noise of poses and readings, and half a cell.
                let is_wall = off.fold(f64::INFINITY, f64::min).abs() < 0.13;
                if is_wall { &mut drawn.walls } else { &mut drawn.wrong }.insert(cell);
            }
        }
    });
    assert!(converged.unwrap());
    let statistics = fleet.robots()[0].robot().statistics();
    assert!(statistics.mapped > 30, "{statistics:?}");
    drawn
}

#[test]
fn a_footprint_keeps_robots_off_the_map_and_walls_on_it() {
    println!(
        "cells of another robot of 1.2 by 0.3 m that were mapped; cells of walls that were not"
    );
    let columns = ["no mask", "square of 0.3 m", "square of 1.2 m", "footprint"];
    println!("{:<26}{:>12}{:>18}{:>18}{:>12}", "", columns[0], columns[1], columns[2], columns[3]);
    for (name, way) in SCENES {
        let none = run(way, Told::Nothing);
        let square = PeerMask::Square;
        let told = [Told::Short(square), Told::Of(square), Told::Of(PeerMask::Footprint)];
        let [short, square, footprint] = told.map(|told| {
            let drawn = run(way, told);
            (drawn.wrong.len(), none.walls.difference(&drawn.walls).count())
        });
        let print = |(wrong, lost)| format!("{wrong}; {lost}");
        let (short_column, square_column) = (print(short), print(square));
        let (none_column, footprint_column) = (print((none.wrong.len(), 0)), print(footprint));
        println!(
            "{name:<26}{none_column:>12}{short_column:>18}{square_column:>18}{footprint_column:>12}"
        );
        assert!(none.wrong.len() >= 50, "{name}: the other robot is not in view");
        assert!(short.0 > 0, "{name}: a short square covers a long robot");
        assert_eq!((square.0, footprint.0), (0, 0), "{name}: the masks let cells through");
        assert!(
            footprint.1 * 4 <= square.1,
            "{name}: more walls lost than a quarter of the square's"
        );
    }
}
