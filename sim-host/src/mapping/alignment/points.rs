//! Converts distance vectors to points.

use core::f64::consts::TAU;

use libm::{cos, sin};
use ubimap_protocol::message::DistanceVector;

/// The reading of a column of a distance vector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// The index of the column.
    pub column: usize,
    /// The distance in millimetres.
    pub distance: f64,
    /// The bearing in `base_link`, in radians.
    pub bearing: f64,
}

/// The points of a distance vector, in millimetres in `base_link`.
pub fn points(vector: &DistanceVector) -> Vec<[f64; 2]> {
    let point = |it: Reading| [it.distance * cos(it.bearing), it.distance * sin(it.bearing)];
    readings(vector).map(point).collect()
}

/// The readings of a distance vector, by column.
pub fn readings(vector: &DistanceVector) -> impl Iterator<Item = Reading> {
    let known = |(_, units): &(usize, &u8)| !matches!(**units, 0 | DistanceVector::BEYOND);
    vector.distances.iter().enumerate().filter(known).map(|(column, &units)| Reading {
        column,
        distance: f64::from(i32::from(units) * DistanceVector::UNIT.0),
        bearing: vector.first.radians() + column as f64 * f64::from(vector.step) * TAU / 65_536.0,
    })
}
