//! Occupants that come and go become movable on the shared map; a person who walks by once does
//! not.

use std::collections::VecDeque;

use ubimap_agent::{Bounds, Config, Memory, sense::SensorModel};
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, TileId},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    channel::fault::Faults,
    run::fleet::{Event, Fleet},
    run::heap::BOUNDS,
};
use ubimap_tests::{deployments::bare, script::Script};

const BEAMS: usize = 61;
/// A cell in the line of sight, 1.5 m away.
const CELL: (i32, i32) = (30, 0);

/// The state of the cell on the map at the end of each of these intervals (end time in seconds, and
/// whether an object stands 1.5 m in front of the robot; otherwise it sees the wall at 3 m).
fn codes(drives: bool, times: &[(u64, bool)]) -> Vec<Cell> {
    let step = 0.02;
    let first = -step * (BEAMS / 2) as f32;
    let sensor = SensorModel::Radial { first, step };
    let bounds = Bounds { readings: BEAMS, ..BOUNDS };
    let config = Config::new(RobotId(1), sensor, bounds).with_drive(None);
    let mut memory = [Memory::new(&bounds)];
    let faults = Faults { latency: Duration::from_millis(30), ..Faults::default() };
    let mut fleet =
        Fleet::new(&[config], &mut memory, faults, 1, bare(config.bounds.resolution)).unwrap();
    let mut codes = Vec::new();
    let mut millis = 0;
    for &(seconds, stands) in times {
        let mut events = VecDeque::new();
        for _ in 0..seconds * 100 {
            millis += 10;
            let now = Instant(millis * 1_000);
            // The robot moves a few centimetres back and forth.
            let off = if drives { 0.05 * (millis as f64 / 300.0).sin() } else { 0.0 };
            let pose = Pose::from_metres(off, 0.01, 0.0);
            if millis % 70 == 0 {
                let robots = vec![Sighting::usual(RobotId(1), pose)];
                let observation = Observation { captured: now, robots, ..Observation::default() };
                events.push_back((now, Event::Observation(observation)));
            }
            if millis % 50 == 0 {
                events.push_back((now, Event::Odometry { robot: 0, pose }));
            }
            // The clocks are synchronised by then.
            if millis % 100 == 50 && millis > 3_000 {
                let readings = (0..BEAMS).map(|beam| {
                    let bearing = f64::from(first + beam as f32 * step);
                    let depth = if stands { 1.51 } else { 3.0 } - off;
                    (depth / bearing.cos() * 1_000.0) as u16
                });
                events.push_back((now, Event::Scan { robot: 0, readings: readings.collect() }));
            }
        }
        let end = Instant(millis * 1_000);
        fleet.run(&mut Script(events), |_| {}).unwrap();
        millis = millis.max(fleet.now().since(end).micros() / 1_000 + millis);
        let id = TileId::of_cell(CELL.0, CELL.1).unwrap();
        let (_, tile) = fleet.server().fused().get(id).expect("it has been mapped");
        codes.push(tile.cell(CELL.0 as usize % TILE_SIDE, CELL.1 as usize % TILE_SIDE));
    }
    codes
}

#[test]
fn a_door_becomes_movable_and_a_passer_by_does_not() {
    use Cell::{Free, Movable, Occupied};
    let times = [(10, true), (6, false), (6, true), (6, false), (6, true), (6, false), (6, true)];
    let door = codes(true, &times);
    assert_eq!(door, [Occupied, Free, Movable, Free, Movable, Free, Movable]);
    // A robot at standstill maps a closed door only once, which is not enough for certainty.
    let door = codes(false, &times);
    assert_eq!(door, [Occupied, Free, Occupied, Free, Movable, Free, Movable]);
    for drives in [true, false] {
        let person = codes(drives, &[(10, false), (4, true), (6, false), (30, false)]);
        assert_eq!(person, [Free, Occupied, Free, Free], "the robot drives: {drives}");
    }
}
