//! A distance vector from a range scan: the nearest reading in each column.

use core::f32::consts::PI;

use heapless::Vec;
use libm::{atan2f, sqrtf};
use ubimap_protocol::{
    message::{DistanceVector, MAX_COLUMNS},
    units::{Angle, Pose},
};

use super::{
    beams::{Beam, DIRECTION_BITS},
    validity::NOTHING_IN_RANGE,
};

/// The unit of distances, in millimetres.
const UNIT: f32 = DistanceVector::UNIT.0 as f32;
/// Width of the column of a lone beam, in binary angle units: 5 degrees.
const ALONE: i32 = 910;

/// The columns of a [`DistanceVector`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Columns {
    /// The bearing of the first column, the rightmost, in `base_link`.
    pub first: Angle,
    /// Angle from one column to the next, in binary angle units.
    pub step: i16,
    /// The nearest reading in each column, in units of 2 cm; 0 if there is none, 255 for 5.1 m and
    /// more.
    pub distances: Vec<u8, MAX_COLUMNS>,
}

impl Columns {
    /// The nearest readings of a scan relative to `base_link`, in columns that divide the field of
    /// view evenly: at most `most`, and at most one per beam. The sensor is mounted at `mounting`;
    /// its heading is already in the beams, which must be ordered by bearing, in either direction.
    /// Without a reading there are no columns. `None` if the sensor has no beams, or if `most` is 0. About 320
    /// instructions per beam.
    pub fn of_scan(beams: &[Beam], readings: &[u16], mounting: Pose, most: usize) -> Option<Self> {
        let usable = beams.iter().filter(|beam| **beam != Beam::NONE);
        let mut bearings = usable.map(|beam| bearing(beam.left.into(), beam.forward.into()));
        let mut edge = bearings.next().filter(|_| most > 0)?;
        let (mut last, mut turn, mut gaps) = (edge, 0, 0);
        for bearing in bearings {
            turn += i32::from((bearing - last).0 as i16);
            gaps += 1;
            last = bearing;
        }
        if turn < 0 {
            (edge, turn) = (last, -turn);
        }
        let mut distances = Vec::new();
        for _ in 0..=gaps.min(most as i32 - 1) {
            // Columns beyond the capacity of a message are dropped.
            let _ = distances.push(0);
        }
        // Each beam is as wide as the gap to the next.
        let beam = turn.checked_div(gaps).unwrap_or(ALONE);
        let count = (distances.len() as i32).max(1);
        let step = ((turn + beam + count - 1) / count).clamp(1, 32_767);
        let right = edge.0.wrapping_sub((beam / 2) as u16);
        let mut any = false;
        for (beam, &reading) in beams.iter().zip(readings) {
            // How far it is free depends on the sensor, which the server does not know.
            if matches!(reading, 0 | NOTHING_IN_RANGE) || *beam == Beam::NONE {
                continue;
            }
            let length = f32::from(reading) / (1 << DIRECTION_BITS) as f32;
            let x = mounting.x.0 as f32 + f32::from(beam.forward) * length;
            let y = mounting.y.0 as f32 + f32::from(beam.left) * length;
            let column = i32::from(bearing(y, x).0.wrapping_sub(right)) / step;
            let distance = ((sqrtf(x * x + y * y) / UNIT + 0.5) as u8).max(1);
            if let Some(nearest) = distances.get_mut(column as usize) {
                *nearest = if *nearest == 0 { distance } else { distance.min(*nearest) };
                any = true;
            }
        }
        if !any {
            distances.clear();
        }
        let first = Angle(right.wrapping_add((step / 2) as u16));
        Some(Self { first, step: step as i16, distances })
    }
}

fn bearing(y: f32, x: f32) -> Angle {
    Angle((atan2f(y, x) * (32_768.0 / PI)) as i32 as u16)
}

#[cfg(test)]
mod tests {
    use std::{vec, vec::Vec};

    use super::*;
    use crate::sense::{SensorModel, fill_beams};
    use proptest::prelude::*;
    use ubimap_protocol::units::Millimetres;

    fn table(beams: usize, model: SensorModel, mounting: Pose) -> Vec<Beam> {
        let mut table = vec![Beam::default(); beams];
        fill_beams(&mut table, model, mounting);
        table
    }

    fn bearings(columns: &Columns) -> Vec<f64> {
        let step = f64::from(columns.step) * 360.0 / 65_536.0;
        (0..columns.distances.len()).map(|i| columns.first.degrees() + i as f64 * step).collect()
    }

    #[test]
    fn a_wall_ahead_is_flat_in_all_columns_of_a_mounted_pinhole() {
        let mounting = Pose::from_metres(0.1, -0.05, 0.0);
        let model = SensorModel::Pinhole { focal: 343.1, centre: 319.5 };
        let beams = table(640, model, mounting);
        let columns = Columns::of_scan(&beams, &[1_400; 640], mounting, 100).unwrap();
        assert_eq!(columns.distances.len(), 64);
        let bearings = bearings(&columns);
        assert!((bearings[0] + 43.0).abs() < 0.8, "{bearings:?}");
        assert!((bearings[63] - 43.0).abs() < 0.8, "{bearings:?}");
        let mut seen = 0;
        for (bearing, &units) in bearings.iter().zip(&columns.distances) {
            let wall = 1_500.0 / bearing.to_radians().cos();
            // The nearest reading of a column may be half a column off its centre, and so up to 20
            // mm nearer.
            let off = f64::from(units) * 20.0 - wall;
            assert!(units == 0 || (-32.0..=10.5).contains(&off), "{bearing}: {units} {off}");
            seen += u32::from(units != 0);
        }
        // Columns that the mounted sensor can't see have no reading.
        assert!((58..64).contains(&seen), "{seen}");
    }

    #[test]
    fn beams_all_round_and_clockwise_ones_fill_all_columns() {
        let step = core::f32::consts::TAU / 360.0;
        for step in [step, -step] {
            let beams = table(360, SensorModel::Radial { first: 0.3, step }, Pose::default());
            let mut readings = [2_000; 360];
            readings[90] = 700;
            let columns = Columns::of_scan(&beams, &readings, Pose::default(), 64).unwrap();
            assert_eq!((columns.distances.len(), columns.step), (64, 1_024));
            let there = (0.3 + 90.0 * f64::from(step)).to_degrees();
            for (bearing, &units) in bearings(&columns).iter().zip(&columns.distances) {
                let aside = (bearing - there + 540.0).rem_euclid(360.0) - 180.0;
                if aside.abs() < 2.5 {
                    assert_eq!(units, 35, "{bearing}");
                } else if aside.abs() > 3.5 {
                    assert_eq!(units, 100, "{bearing}");
                }
            }
        }
    }

    #[test]
    fn a_single_beam_gives_one_column_and_no_reading_none() {
        let beams = table(1, SensorModel::Radial { first: 0.5, step: 0.1 }, Pose::default());
        let found = |reading, most| Columns::of_scan(&beams, &[reading], Pose::default(), most);
        let columns = found(6_000, 64).unwrap();
        assert!((columns.first.radians() - 0.5).abs() < 0.001);
        assert_eq!(&columns.distances[..], [255]);
        assert_eq!(&found(1, 64).unwrap().distances[..], [1]);
        assert_eq!(found(0, 64).unwrap().distances.len(), 0);
        assert_eq!(found(6_000, 0), None);
        assert_eq!(Columns::of_scan(&[], &[], Pose::default(), 64), None);
    }

    proptest! {
        #[test]
        fn any_scan_gives_a_valid_vector(
            beams in proptest::collection::vec((any::<i16>(), any::<i16>()), 0..100),
            readings in proptest::collection::vec(any::<u16>(), 0..100),
            x in any::<i32>(), y in any::<i32>(), most in 0usize..100,
        ) {
            let beams: Vec<_> = beams
                .into_iter()
                .map(|(forward, left)| Beam { forward, left })
                .collect();
            let mounting = Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle(0) };
            if let Some(columns) = Columns::of_scan(&beams, &readings, mounting, most) {
                prop_assert!(columns.distances.len() <= most.min(64));
                prop_assert!(columns.distances.is_empty() || columns.distances.iter().any(|it| *it > 0));
                prop_assert!(columns.step > 0);
            }
        }
    }
}
