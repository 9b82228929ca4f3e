//! A scan reduced to the nearest point of each group of beams, for the drive's steps.

use heapless::Vec;
use ubimap_protocol::{time::Instant, units::Pose};

use super::root::root;
use crate::sense::{Beam, DIRECTION_BITS, Validity};

/// Maximum number of points.
pub const MAX_POINTS: usize = 64;

/// A raw scan.
#[derive(Clone, Copy, Debug)]
pub struct Seen<'s> {
    /// When it was taken.
    pub taken: Instant,
    /// Readings as in a [`Scan`](crate::device::Scan).
    pub readings: &'s [u16],
    /// The beam of each reading; [`Beam::NONE`] for removed ones.
    pub beams: &'s [Beam],
    /// Which readings are valid.
    pub validity: Validity,
    /// The sensor in `base_link`; the beams include its heading.
    pub mounting: Pose,
}

/// The nearest points of a scan, in `base_link`, in millimetres.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NearPoints {
    points: Vec<(f32, f32), MAX_POINTS>,
    taken: Option<Instant>,
}

impl NearPoints {
    /// The nearest valid reading of each group of consecutive beams; there are [`MAX_POINTS`]
    /// groups. About 20 instructions per beam.
    pub fn of_scan(scan: &Seen<'_>) -> Self {
        let mut near = Self { points: Vec::new(), taken: Some(scan.taken) };
        let each = scan.beams.len().div_ceil(MAX_POINTS).max(1);
        let stretches = scan.beams.chunks(each).zip(scan.readings.chunks(each));
        for (number, (beams, readings)) in stretches.enumerate() {
            if let Some(point) = scan.nearest(number * each, beams, readings) {
                // There are at most as many groups as points.
                let _ = near.points.push(point);
            }
        }
        near
    }

    /// When the scan was taken; `None` if there has been none.
    pub fn taken(&self) -> Option<Instant> {
        self.taken
    }

    /// The points: distances forward and to the left.
    pub fn points(&self) -> &[(f32, f32)] {
        &self.points
    }

    /// Distance to the nearest point.
    pub fn nearest(&self) -> Option<f32> {
        let squares = self.points.iter().map(|(x, y)| x * x + y * y);
        squares.reduce(f32::min).map(root)
    }
}

impl Seen<'_> {
    /// The point of the nearest valid reading in a group of beams whose first index is `first`.
    fn nearest(&self, first: usize, beams: &[Beam], readings: &[u16]) -> Option<(f32, f32)> {
        let one = 1.0 / (1 << DIRECTION_BITS) as f32;
        let mut nearest = None;
        let mut least = f32::INFINITY;
        for ((index, beam), &reading) in (first..).zip(beams).zip(readings) {
            if *beam == Beam::NONE || reading == 0 {
                continue;
            }
            let length = f32::from(reading) * one;
            let x = f32::from(beam.forward) * length + self.mounting.x.0 as f32;
            let y = f32::from(beam.left) * length + self.mounting.y.0 as f32;
            let square = x * x + y * y;
            if square < least && self.validity.counts_at(self.readings, index, reading) {
                (nearest, least) = (Some((x, y)), square);
            }
        }
        nearest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sense::{Removal, SensorModel, fill_beams, remove_beams};

    const COUNT: usize = 256;

    fn beams() -> [Beam; COUNT] {
        let mut beams = [Beam::default(); COUNT];
        let step = core::f32::consts::TAU / COUNT as f32;
        fill_beams(&mut beams, SensorModel::Radial { first: 0.0, step }, Pose::default());
        beams
    }

    fn seen<'s>(beams: &'s [Beam], readings: &'s [u16], validity: Validity) -> Seen<'s> {
        Seen { taken: Instant(5), readings, beams, validity, mounting: Pose::default() }
    }

    #[test]
    fn the_nearest_reading_of_each_group_is_kept() {
        let beams = beams();
        let mut readings = [2_000; COUNT];
        // 90 degrees to the left, and an invalid reading beside it.
        readings[64] = 700;
        readings[65] = 0;
        readings[128] = 4_001;
        let mounting = Pose { x: ubimap_protocol::units::Millimetres(100), ..Pose::default() };
        let scan = Seen { mounting, ..seen(&beams, &readings, Validity::default()) };
        let near = NearPoints::of_scan(&scan);
        assert_eq!((near.points().len(), near.taken()), (64, Some(Instant(5))));
        let (x, y) = near.points()[16];
        assert!((x - 100.0).abs() < 1.0 && (y - 700.0).abs() < 1.0, "{x} {y}");
        assert!((near.nearest().unwrap() - 707.1).abs() < 1.0);
    }

    /// Readings excluded from the map must not stop the robot either.
    #[test]
    fn invalid_readings_and_removed_beams_are_no_obstacles() {
        let nearest = |readings: &[u16], beams: &[Beam], validity| {
            let near = NearPoints::of_scan(&seen(beams, readings, validity)).nearest();
            libm::roundf(near.unwrap()) as u32
        };
        let usual = Validity::default();
        let mut readings = [2_000; COUNT];
        // Below the sensor's minimum range.
        readings[10] = 90;
        assert_eq!(nearest(&readings, &beams(), usual), 90);
        assert_eq!(nearest(&readings, &beams(), Validity { nearest: 100, ..usual }), 2_000);
        assert_eq!(nearest(&readings, &beams(), Validity { removed: (80, 95), ..usual }), 2_000);
        // The robot's own mast.
        let mut without = beams();
        remove_beams(&mut without, Removal::Pixels { first: 9, last: 11 });
        assert_eq!(nearest(&readings, &without, usual), 2_000);
        // A flying pixel at the edge of a box, between two groups: the edge of the box remains.
        let mut readings = [2_000; COUNT];
        readings[13..16].fill(1_000);
        readings[16] = 1_500;
        let edge = |validity| {
            let (beams, near) = (beams(), |it: &[u16]| it.to_vec());
            let near = NearPoints::of_scan(&seen(&beams, &near(&readings), validity));
            let (x, y) = near.points()[4];
            libm::roundf(libm::hypotf(x, y)) as u32
        };
        assert_eq!(edge(usual), 1_500);
        assert_eq!(edge(Validity { flying: 150, ..usual }), 2_000);
    }
}
