//! Converts distance vectors to points.

use core::f64::consts::TAU;

use libm::{cos, sin};
use ubimap_protocol::message::{DistanceVector, MAX_COLUMNS};

/// How far towards its nearer side the nearest reading of a column is, as a share of the column. That is right for 2.5
/// beams per column; for one it would be 0, for 1.6 some 0.2, for five 0.4, for very many 0.5.
const NEARER: f64 = 0.3;

/// The reading of a column of a distance vector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// The index of the column.
    pub column: usize,
    /// The distance in millimetres.
    pub distance: f64,
    /// The bearing in `base_link`, in radians.
    pub bearing: f64,
    /// The change of the bearing, in radians, if `NEARER` grows by one; 0 if columns are single beams.
    pub lean: f64,
}

/// The points of a distance vector, in millimetres in `base_link`.
pub fn points(vector: &DistanceVector) -> Vec<[f64; 2]> {
    let point = |it: Reading| [it.distance * cos(it.bearing), it.distance * sin(it.bearing)];
    readings(vector).map(point).collect()
}

/// The readings of a distance vector, by column.
///
/// A column that merges several beams holds their nearest reading, which comes from the side of the column where the surface
/// is nearer. So its bearing is moved to that side. Sensors with as many columns as there can be are assumed to have a few
/// beams in each.
pub fn readings(vector: &DistanceVector) -> impl Iterator<Item = Reading> {
    let merged = vector.distances.len() == MAX_COLUMNS;
    let reading = |column: usize| match vector.distances.get(column) {
        None | Some(&(0 | DistanceVector::BEYOND)) => None,
        Some(&units) => Some(i32::from(units)),
    };
    let columns = 0..vector.distances.len();
    columns.filter_map(move |column| {
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
        let side = if merged { -f64::from(slope.clamp(-4, 4)) / 4.0 } else { 0.0 };
        let angle = |columns: f64| columns * f64::from(vector.step) * TAU / 65_536.0;
        Some(Reading {
            column,
            distance: f64::from(here * DistanceVector::UNIT.0),
            bearing: vector.first.radians() + angle(column as f64 + NEARER * side),
            lean: angle(side),
        })
    })
}
