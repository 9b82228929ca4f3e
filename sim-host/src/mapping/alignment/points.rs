//! Converts distance vectors to points.

use core::f64::consts::TAU;

use libm::{cos, sin};
use ubimap_protocol::message::{DistanceVector, MAX_COLUMNS};

/// The points of a distance vector, in millimetres in `base_link`.
///
/// A column that merges several beams holds their nearest reading, which comes from the side of the
/// column where the surface is nearer. So the point is moved to that side by 0.3 of a column, which
/// is right for 2.5 beams per column (for very many beams it would be 0.45). Sensors with more
/// beams than columns are assumed to have a few per column.
pub fn points(vector: &DistanceVector) -> Vec<[f64; 2]> {
    let merged = vector.distances.len() == MAX_COLUMNS;
    let reading = |column: usize| match vector.distances.get(column) {
        None | Some(&(0 | DistanceVector::BEYOND)) => None,
        Some(&units) => Some(i32::from(units)),
    };
    let columns = 0..vector.distances.len();
    let found = columns.filter_map(|column| {
        let here = reading(column)?;
        // A jump in distance separates surfaces, so the column beyond it does not count as a
        // neighbour. From a column to the next, a wall that is seen at 10 degrees recedes by a
        // third. If one neighbour is missing, as at the end of the range, the other one is
        // extrapolated.
        let beside =
            |column: usize| reading(column).filter(|it| (it - here).abs() < (here / 3).max(15));
        let (before, after) = (column.checked_sub(1).and_then(beside), beside(column + 1));
        // The slope in units of 2 cm per two columns.
        let slope = match (before, after) {
            (Some(before), Some(after)) => after - before,
            (Some(before), None) => 2 * (here - before),
            (None, Some(after)) => 2 * (after - here),
            (None, None) => 0,
        };
        let side = if merged { -0.3 * f64::from(slope.clamp(-4, 4)) / 4.0 } else { 0.0 };
        let bearing = vector.first.radians()
            + (column as f64 + side) * f64::from(vector.step) * TAU / 65_536.0;
        let distance = f64::from(here * DistanceVector::UNIT.0);
        Some([distance * cos(bearing), distance * sin(bearing)])
    });
    found.collect()
}
