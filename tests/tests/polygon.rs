//! Compares the polygon that a robot fills for a scan, cell by cell, with a line of cells per beam,
//! in random rooms.
//!
//! The beams are closer together than cells, so that the lines determine every cell in view. The
//! polygon may differ from them only in these cells:
//!
//! - next to a cell in which the lines have another state, because the polygon uses the centres of
//!   cells and keeps half a cell before a hit; two cells away where redundant readings are omitted,
//!   because surfaces are then drawn as lines between some of their readings;
//! - whose centres lie next to an invalid beam, or between two beams, one of which passes an edge:
//!   nothing is claimed there that only one of the two beams crossed;
//! - where a surface is in view for less than the width of a cell: it may be missed, as only three
//!   beams per two cells are checked.

use std::collections::HashSet;

use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{
    Bounds, Config, Memory, Settings,
    map::{LocalMap, MappingConfig, Policy, Pool, Surround},
    sense::{Validity, fill_beams},
};
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE},
    time::Instant,
    units::{Angle, Pose, RobotId},
};
use ubimap_sim_host::run::heap::{BOUNDS, Heap};
use ubimap_tests::{
    boxes::{Boxes, Fan},
    per_ray::{self, Seen},
};

type Cells = HashSet<(i32, i32)>;

/// The beams are 17 mm apart at 4 m.
const FAN: Fan = Fan { beams: 481, angle: 2.0 };
const MAX_RANGE: u16 = 4_000;

/// The free and the occupied cells of the robot's map after one scan.
fn filled(pose: Pose, readings: &[u16], policy: Policy) -> (Cells, Cells) {
    filled_within(MAX_RANGE, MAX_RANGE, pose, readings, policy)
}

/// Like `filled`, for a map with a maximum range and a scan that is mapped up to `range`.
fn filled_within(
    max_range: u16,
    range: u16,
    pose: Pose,
    readings: &[u16],
    policy: Policy,
) -> (Cells, Cells) {
    let bounds = Bounds { readings: FAN.beams, own_tiles: 40, max_range, ..BOUNDS };
    let settings = Settings::from(&Config::new(RobotId(1), FAN.model(), bounds));
    let mut memory = Memory::<Heap>::new(&bounds);
    let memory = memory.slices();
    fill_beams(memory.beams, settings.sensor, settings.mounting);
    let validity = Validity::default();
    let mapping = MappingConfig { validity, policy, near: MAX_RANGE / 8, ..(&settings).into() };
    let mut map = LocalMap::new(mapping, memory.beams, memory.scratch, Pool::new(memory.own));
    let mapped = map.add(memory.beams, readings, (pose, range), |_| Surround::default()).unwrap();
    assert_eq!(mapped.cells_refused, 0);
    let (mut free, mut hit) = (Cells::new(), Cells::new());
    for tile in map.pool.tiles() {
        let (x0, y0) = tile.id().unwrap().first_cell();
        let cells = tile.cells();
        for (x, y) in (0..TILE_SIDE).flat_map(|y| (0..TILE_SIDE).map(move |x| (x, y))) {
            let cell = (x0 + x as i32, y0 + y as i32);
            match cells.cell(x, y) {
                Cell::Unknown => false,
                Cell::Free => free.insert(cell),
                _ => hit.insert(cell),
            };
        }
    }
    (free, hit)
}

fn around((x, y): (i32, i32), reach: i32) -> impl Iterator<Item = (i32, i32)> {
    let off = -reach..=reach;
    off.clone().flat_map(move |dx| off.clone().map(move |dy| (x + dx, y + dy)))
}

fn beside(cells: &Cells, cell: (i32, i32), reach: i32) -> bool {
    around(cell, reach).any(|it| cells.contains(&it))
}

/// Whether a cell's centre lies next to an invalid beam, or where the range jumps.
fn is_in_a_gap((x, y): (i32, i32), from: [f64; 2], pose: Pose, readings: &[u16]) -> bool {
    let middle = [x, y].map(|cell| (f64::from(cell) + 0.5) * 0.05);
    let (dx, dy) = (middle[0] - from[0], middle[1] - from[1]);
    let turn = std::f64::consts::TAU;
    let bearing = dy.atan2(dx) - pose.heading.radians();
    let bearing = (bearing + turn / 2.0).rem_euclid(turn) - turn / 2.0;
    let step = FAN.angle / (FAN.beams - 1) as f64;
    let place = (bearing + FAN.angle / 2.0) / step;
    // The polygon's sides are accurate to 3 mm. A jump is a difference of 150 mm, minus the half
    // cell kept before a hit.
    let slack = 0.003 / (dx.hypot(dy) * step).max(0.001);
    let (first, last) = ((place - slack).floor(), (place + slack).ceil());
    let of = |beam: f64| readings.get(beam as usize).map(|&it| it.min(MAX_RANGE)).unwrap_or(0);
    let beams: Vec<u16> = (first as i64..=last as i64).map(|beam| of(beam as f64)).collect();
    first < 0.0 || beams.contains(&0) || beams.windows(2).any(|two| two[0].abs_diff(two[1]) > 120)
}

/// Keeps only the readings of surfaces in view for at least a cell's width: adjacent readings
/// differ by less than three quarters of a cell.
fn broad(readings: &[u16]) -> Vec<u16> {
    let mut broad = vec![0; readings.len()];
    let step = FAN.angle / (FAN.beams - 1) as f64;
    let goes_on = |a: &u16, b: &u16| {
        let is_hit = |reading: u16| (1..=MAX_RANGE).contains(&reading);
        is_hit(*a) && is_hit(*b) && a.abs_diff(*b) <= 37
    };
    let mut start = 0;
    for run in readings.chunk_by(goes_on) {
        let nearest = run.iter().copied().min().unwrap_or(0);
        if (run.len() - 1) as f64 * step * f64::from(nearest) >= 50.0 {
            broad[start..start + run.len()].copy_from_slice(run);
        }
        start += run.len();
    }
    broad
}

/// The cells by a line per beam.
fn lines(readings: &[u16], from: [f64; 2], pose: Pose) -> Seen {
    let beams = readings.iter().enumerate().map(|(beam, &reading)| {
        let place = beam as f64 / (FAN.beams - 1) as f64 - 0.5;
        (pose.heading.radians() + place * FAN.angle, f64::from(reading) / 1_000.0)
    });
    per_ray::scan(from, beams, 0.05, f64::from(MAX_RANGE) / 1_000.0)
}

/// Whether the exceptions do not apply to a crossed cell, so that the polygon must contain it as
/// free.
fn is_comparable(
    cell: (i32, i32),
    reach: i32,
    lines: &Seen,
    from: [f64; 2],
    pose: Pose,
    readings: &[u16],
) -> bool {
    around(cell, reach).all(|it| lines.crossed.contains(&it))
        && !beside(&lines.hit, cell, reach)
        && !is_in_a_gap(cell, from, pose, readings)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(150))]

    #[test]
    fn the_polygon_matches_a_line_per_beam(
        seed: u64, heading: u16, second in 0..20u64, full: bool,
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let room = Boxes::random(&mut rng);
        let [x, y] = room.point(&mut rng);
        let pose = Pose { heading: Angle(heading), ..Pose::from_metres(x, y, 0.0) };
        let from = [pose.x.metres(), pose.y.metres()];
        let readings = room.scan(FAN, pose, Instant(second * 1_000_000));
        let (policy, reach) = if full { (Policy::Full, 2) } else { (Policy::Threshold, 1) };
        let (free, hit) = filled(pose, &readings, policy);
        let surfaces = lines(&broad(&readings), from, pose).hit;
        let lines = lines(&readings, from, pose);

        for &cell in &free {
            prop_assert!(beside(&lines.crossed, cell, reach), "{cell:?} is free, but no beam crossed near it");
        }
        for &cell in &hit {
            prop_assert!(beside(&lines.hit, cell, reach), "{cell:?} is occupied, but no beam ended near it");
        }
        for &cell in &surfaces {
            prop_assert!(beside(&hit, cell, reach), "a beam ended in {cell:?}, but nothing near it is occupied");
        }
        for &cell in &lines.crossed {
            if is_comparable(cell, reach, &lines, from, pose, &readings) {
                prop_assert!(free.contains(&cell), "{cell:?} was crossed, but is not free");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn an_uncertain_robot_maps_a_scan_with_a_shorter_range(
        seed: u64, heading: u16, range in 60..MAX_RANGE,
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let room = Boxes::random(&mut rng);
        let [x, y] = room.point(&mut rng);
        let pose = Pose { heading: Angle(heading), ..Pose::from_metres(x, y, 0.0) };
        let readings = room.scan(FAN, pose, Instant(0));
        let of = |max_range, policy| filled_within(max_range, range, pose, &readings, policy);
        prop_assert!(of(MAX_RANGE, Policy::Threshold) == of(range, Policy::Threshold));
        // Where beams may be skipped, the two maps may skip different beams.
        let (cut, less) = (of(MAX_RANGE, Policy::Full), of(range, Policy::Full));
        prop_assert!(cut.0.iter().all(|&cell| beside(&less.0, cell, 1)));
        prop_assert!(less.0.iter().all(|&cell| beside(&cut.0, cell, 1)));
        prop_assert!(cut.1.iter().all(|&cell| beside(&less.1, cell, 2)));
        prop_assert!(less.1.iter().all(|&cell| beside(&cut.1, cell, 2)));
    }
}

/// The exceptions are not too wide: over many rooms, most of the crossed cells are compared.
#[test]
fn most_of_the_crossed_cells_are_compared() {
    let (mut compared, mut crossed) = (0, 0);
    for seed in 0..40 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let room = Boxes::random(&mut rng);
        let [x, y] = room.point(&mut rng);
        let pose = Pose { heading: Angle(seed as u16 * 1_601), ..Pose::from_metres(x, y, 0.0) };
        let from = [pose.x.metres(), pose.y.metres()];
        let readings = room.scan(FAN, pose, Instant(0));
        let lines = lines(&readings, from, pose);
        crossed += lines.crossed.len();
        let is_compared =
            |cell: &&(i32, i32)| is_comparable(**cell, 2, &lines, from, pose, &readings);
        compared += lines.crossed.iter().filter(is_compared).count();
    }
    assert!(compared * 2 > crossed, "{compared} of {crossed}");
}
