//! The oracle for the onboard pipeline: a plain occupancy map with one line of cells per beam, in
//! floating point, from a scan or a CARMEN log. It shares no code with the code under test.

use std::{
    collections::{HashMap, HashSet},
    f64::consts::{FRAC_PI_2, PI},
};

/// Log odds of the observed cells.
pub type LogOdds = HashMap<(i32, i32), f64>;

/// Log odds added to the cell in which a beam ends.
const HIT: f64 = 0.85;
/// Log odds added to a cell that a beam crosses.
const MISS: f64 = -0.4;
/// Maximum absolute log odds of a cell.
const CLAMP: f64 = 4.0;

/// The map of all `FLASER` records of a log; `resolution` and `max_range` in metres. Readings of
/// `no_return` metres or more are ignored.
pub fn map(log: &str, resolution: f64, max_range: f64, no_return: f64) -> LogOdds {
    let mut cells = LogOdds::new();
    let mut mapped: Option<[f64; 3]> = None;
    for line in log.lines().filter(|line| line.starts_with("FLASER")) {
        let numbers: Vec<f64> =
            line.split_whitespace().skip(1).filter_map(|word| word.parse().ok()).collect();
        let beams = numbers[0] as usize;
        let ranges = &numbers[1..=beams];
        let pose = [numbers[beams + 1], numbers[beams + 2], numbers[beams + 3]];
        // The paper's threshold: 3.5 cm or 5 degrees.
        let moved = mapped.is_none_or(|last| {
            let turn = (pose[2] - last[2] + PI).rem_euclid(2.0 * PI) - PI;
            (pose[0] - last[0]).hypot(pose[1] - last[1]) > 0.035 || turn.abs().to_degrees() > 5.0
        });
        if !moved {
            continue;
        }
        mapped = Some(pose);
        let step = PI / if beams % 2 == 1 { beams - 1 } else { beams } as f64;
        for (beam, &range) in ranges.iter().enumerate() {
            if range <= 0.0 || range >= no_return {
                continue;
            }
            let bearing = pose[2] - FRAC_PI_2 + beam as f64 * step;
            let reach = range.min(max_range);
            let end = [pose[0] + reach * bearing.cos(), pose[1] + reach * bearing.sin()];
            let from = [pose[0], pose[1]];
            ray(resolution, from, end, |cell, is_end| {
                let odds = if is_end && range <= max_range { HIT } else { MISS };
                let value = cells.entry(cell).or_default();
                *value = (*value + odds).clamp(-CLAMP, CLAMP);
            });
        }
    }
    cells
}

/// The cells observed by the beams of one scan.
#[derive(Clone, Debug, Default)]
pub struct Seen {
    /// Cells that a beam crossed or ended in.
    pub crossed: HashSet<(i32, i32)>,
    /// Cells that a beam ended in.
    pub hit: HashSet<(i32, i32)>,
}

/// One scan from a point, in metres, with a bearing in `map` and a range for each beam. A range of
/// 0 is ignored; for one beyond `max_range`, the cells up to `max_range` are free.
pub fn scan(
    from: [f64; 2],
    beams: impl Iterator<Item = (f64, f64)>,
    resolution: f64,
    max_range: f64,
) -> Seen {
    let mut seen = Seen::default();
    for (bearing, range) in beams.filter(|(_, range)| *range > 0.0) {
        let reach = range.min(max_range);
        let end = [from[0] + reach * bearing.cos(), from[1] + reach * bearing.sin()];
        ray(resolution, from, end, |cell, is_end| {
            seen.crossed.insert(cell);
            if is_end && range <= max_range {
                seen.hit.insert(cell);
            }
        });
    }
    seen
}

/// Visits each cell that a ray crosses once, and then its last one.
fn ray(resolution: f64, from: [f64; 2], to: [f64; 2], mut visit: impl FnMut((i32, i32), bool)) {
    let cell = |point: [f64; 2]| {
        ((point[0] / resolution).floor() as i32, (point[1] / resolution).floor() as i32)
    };
    let last = cell(to);
    let length = (to[0] - from[0]).hypot(to[1] - from[1]);
    let steps = (length / (resolution * 0.1)).ceil().max(1.0) as usize;
    let mut seen = None;
    for step in 0..=steps {
        let part = step as f64 / steps as f64;
        let here = cell([from[0] + (to[0] - from[0]) * part, from[1] + (to[1] - from[1]) * part]);
        if seen != Some(here) && here != last {
            visit(here, false);
        }
        seen = Some(here);
    }
    visit(last, true);
}
