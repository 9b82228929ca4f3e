//! A scan thinned to a few points about the robot, the nearest of each stretch: what the steps of a
//! drive look at.

use heapless::Vec;
use ubimap_protocol::{time::Instant, units::Pose};

use super::root::root;
use crate::sense::{Beam, DIRECTION_BITS};

/// The most points.
pub const MAX_POINTS: usize = 64;

/// The nearest points of a scan, in `base_link`, in millimetres.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NearPoints {
    points: Vec<(f32, f32), MAX_POINTS>,
    taken: Option<Instant>,
}

impl NearPoints {
    /// Of a scan taken at `taken`: of each [`MAX_POINTS`]th of its beams the nearest valid
    /// reading. The sensor is mounted at `mounting` in `base_link`, its heading is in the beams.
    /// About 20 instructions a beam.
    pub fn of_scan(beams: &[Beam], readings: &[u16], mounting: Pose, taken: Instant) -> Self {
        let mut near = Self { points: Vec::new(), taken: Some(taken) };
        let each = beams.len().div_ceil(MAX_POINTS).max(1);
        let one = 1.0 / (1 << DIRECTION_BITS) as f32;
        for (beams, readings) in beams.chunks(each).zip(readings.chunks(each)) {
            let points = beams
                .iter()
                .zip(readings)
                .filter(|(beam, reading)| **beam != Beam::NONE && **reading != 0);
            let points = points.map(|(beam, &reading)| {
                let reading = f32::from(reading) * one;
                let x = f32::from(beam.forward) * reading + mounting.x.0 as f32;
                let y = f32::from(beam.left) * reading + mounting.y.0 as f32;
                (x, y)
            });
            let square = |(x, y): (f32, f32)| x * x + y * y;
            let nearest = points.reduce(|a, b| if square(b) < square(a) { b } else { a });
            if let Some(point) = nearest {
                // No more than there are stretches.
                let _ = near.points.push(point);
            }
        }
        near
    }

    /// When the scan was taken; `None` if there has been none.
    pub fn taken(&self) -> Option<Instant> {
        self.taken
    }

    /// The points: forward, left.
    pub fn points(&self) -> &[(f32, f32)] {
        &self.points
    }

    /// How near the nearest point is.
    pub fn nearest(&self) -> Option<f32> {
        let squares = self.points.iter().map(|(x, y)| x * x + y * y);
        squares.reduce(f32::min).map(root)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sense::{SensorModel, fill_beams};

    #[test]
    fn the_nearest_of_each_stretch_is_kept() {
        let mut beams = [Beam::default(); 256];
        let step = core::f32::consts::TAU / 256.0;
        let model = SensorModel::Radial { first: 0.0, step };
        fill_beams(&mut beams, model, Pose::default());
        let mut readings = [2_000; 256];
        // A quarter of a turn to the left, and an invalid one beside it.
        readings[64] = 700;
        readings[65] = 0;
        readings[128] = 4_001;
        let mounting = Pose { x: ubimap_protocol::units::Millimetres(100), ..Pose::default() };
        let near = NearPoints::of_scan(&beams, &readings, mounting, Instant(5));
        assert_eq!((near.points().len(), near.taken()), (64, Some(Instant(5))));
        let (x, y) = near.points()[16];
        assert!((x - 100.0).abs() < 1.0 && (y - 700.0).abs() < 1.0, "{x} {y}");
        assert!((near.nearest().unwrap() - 707.1).abs() < 1.0);
    }
}
