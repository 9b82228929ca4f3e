//! What a robot saw from one pose.

use nalgebra::Vector2;
use ubimap_protocol::{message::DistanceVector, time::Instant};

use super::{
    cloud::{Surfel, surfels},
    columns::Columns,
    rigid::{Motion, motion},
};
use crate::mapping::{Reading, readings};

/// What a robot saw from one pose, in metres in `base_link`.
#[derive(Clone, Debug)]
pub struct View {
    /// When, by the server's clock.
    pub time: Instant,
    /// The pose that the robot reported.
    pub reported: Motion,
    /// The surfaces.
    pub surfels: Vec<Surfel>,
    /// The readings that they are from.
    pub(super) readings: Vec<Reading>,
    /// Points up to which the ground is free, without a surface there.
    pub open: Vec<Vector2<f64>>,
    /// The free ground in each column: from the robot to the line between these points.
    pub free: Vec<[Vector2<f64>; 2]>,
}

/// What is free ends this far before the surface that was seen, in metres.
const BEFORE_M: f64 = 0.1;

impl View {
    /// The view of a distance vector.
    pub fn of(vector: &DistanceVector) -> Self {
        let readings: Vec<Reading> = readings(vector).collect();
        let unit = f64::from(DistanceVector::UNIT.0) / 1_000.0;
        let far = f64::from(DistanceVector::BEYOND) * unit;
        let turn = core::f64::consts::TAU / 65_536.0 * f64::from(vector.step);
        let at = |column: f64, range: f64| {
            let bearing = vector.first.radians() + column * turn;
            Vector2::new(libm::cos(bearing), libm::sin(bearing)) * range
        };
        let free = vector.distances.iter().enumerate().filter(|(_, it)| **it > 0);
        let free = free.map(|(column, &distance)| {
            let range = match distance {
                DistanceVector::BEYOND => far,
                distance => (f64::from(distance) * unit - BEFORE_M).max(0.0),
            };
            [-0.5, 0.5].map(|side| at(column as f64 + side, range))
        });
        let open = vector.distances.iter().enumerate();
        let open = open.filter(|(_, distance)| **distance == DistanceVector::BEYOND);
        let open = open.map(|(column, _)| at(column as f64, far));
        Self {
            time: vector.time,
            reported: motion(vector.pose),
            surfels: surfels(&points(&readings, &Columns::default())),
            readings,
            open: open.collect(),
            free: free.collect(),
        }
    }

    /// Moves the surfels to where the columns of the sensor are.
    pub(super) fn calibrate(&mut self, columns: &Columns) {
        self.surfels = surfels(&points(&self.readings, columns));
    }
}

/// The points of readings, in metres in `base_link`.
fn points(readings: &[Reading], columns: &Columns) -> Vec<Vector2<f64>> {
    let point = |reading: &Reading| {
        let bearing = columns.bearing(reading);
        Vector2::new(libm::cos(bearing), libm::sin(bearing)) * reading.distance / 1_000.0
    };
    readings.iter().map(point).collect()
}
