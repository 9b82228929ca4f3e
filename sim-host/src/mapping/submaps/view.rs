//! What a robot saw from one pose.

use nalgebra::Vector2;
use ubimap_protocol::{message::DistanceVector, time::Instant};

use super::{
    cloud::{Surfel, surfels},
    rigid::{Motion, motion},
};
use crate::mapping::points;

/// What a robot saw from one pose, in metres in `base_link`.
#[derive(Clone, Debug)]
pub struct View {
    /// When, by the server's clock.
    pub time: Instant,
    /// The pose that the robot reported.
    pub reported: Motion,
    /// The surfaces.
    pub surfels: Vec<Surfel>,
    /// Points up to which the ground is free, without a surface there.
    pub open: Vec<Vector2<f64>>,
}

impl View {
    /// The view of a distance vector.
    pub fn of(vector: &DistanceVector) -> Self {
        let points: Vec<Vector2<f64>> =
            points(vector).iter().map(|&[x, y]| Vector2::new(x, y) / 1_000.0).collect();
        let far = f64::from(i32::from(DistanceVector::BEYOND) * DistanceVector::UNIT.0) / 1_000.0;
        let open = vector.distances.iter().enumerate().filter_map(|(column, &distance)| {
            let turn = column as f64 * f64::from(vector.step) * core::f64::consts::TAU / 65_536.0;
            let bearing = vector.first.radians() + turn;
            (distance == DistanceVector::BEYOND)
                .then(|| Vector2::new(libm::cos(bearing), libm::sin(bearing)) * far)
        });
        Self {
            time: vector.time,
            reported: motion(vector.pose),
            surfels: surfels(&points),
            open: open.collect(),
        }
    }
}
