//! A distance vector from a range scan: the distance in the middle of each column.

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
    /// The distance in the middle of each column, in units of 2 cm; 0 if unknown, 255 for 5.1 m and more.
    pub distances: Vec<u8, MAX_COLUMNS>,
}

impl Columns {
    /// The distances of a scan from `base_link`, in columns that divide the field of
    /// view evenly: at most `most`, and at most one per beam. The sensor is mounted at `mounting`;
    /// its heading is already in the beams, which must be ordered by bearing, in either direction.
    /// Without a reading there are no columns. `None` if the sensor has no beams, or if `most` is 0. About 340
    /// instructions per beam.
    ///
    /// The distance in the middle of a column is interpolated between the beams beside it; where they are not on one
    /// surface, it is that of the first beam in the column. The least one in the column would bend walls: it comes from
    /// the side where the wall is nearer.
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
        // Of the last beam with a reading: its bearing from the right edge, the number of columns' middles up to it, and
        // its distance.
        let mut last = (-65_536, 0, 0.0);
        let mut any = false;
        for (direction, &reading) in beams.iter().zip(readings) {
            // How far it is free depends on the sensor, which the server does not know.
            if matches!(reading, 0 | NOTHING_IN_RANGE) || *direction == Beam::NONE {
                continue;
            }
            let scale = f32::from(reading) / (1 << DIRECTION_BITS) as f32;
            let x = mounting.x.0 as f32 + f32::from(direction.forward) * scale;
            let y = mounting.y.0 as f32 + f32::from(direction.left) * scale;
            let at = i32::from(bearing(y, x).0.wrapping_sub(right));
            let column = at / step;
            let middles = column + i32::from(at % step >= step / 2);
            let distance = sqrtf(x * x + y * y) / UNIT;
            let (before, its, nearer) = core::mem::replace(&mut last, (at, middles, distance));
            let mut set = |column: i32, distance: f32, is_better: bool| {
                if let Some(known) = distances.get_mut(column as usize)
                    && (is_better || *known == 0)
                {
                    *known = ((distance + 0.5) as u8).max(1);
                    any = true;
                }
            };
            set(column, distance, false);
            // A jump in distance is from one surface to another.
            if middles != its
                && (at - before).abs() <= 2 * beam
                && (distance - nearer).abs() <= distance / 8.0
            {
                let column = middles.max(its) - 1;
                let part = (column * step + step / 2 - before) as f32 / (at - before) as f32;
                set(column, nearer + (distance - nearer) * part, true);
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
        // Of the outermost columns the sensor may see a side only.
        for (bearing, &units) in bearings.iter().zip(&columns.distances).take(63).skip(1) {
            let wall = 1_500.0 / bearing.to_radians().cos();
            let off = f64::from(units) * 20.0 - wall;
            assert!(units == 0 || off.abs() < 10.5, "{bearing}: {units} {off}");
            seen += u32::from(units != 0);
        }
        // Columns that the mounted sensor can't see have no reading.
        assert!((58..64).contains(&seen), "{seen}");
    }

    /// A wall that each of the beams sees where it is, by beams that are not in the columns' middles.
    #[test]
    fn a_slanted_wall_is_straight_all_round_and_clockwise() {
        for (beams, step) in [(100, 0.012), (100, -0.012), (360, 0.0174), (64, 0.05), (70, 0.03)] {
            let model = SensorModel::Radial { first: 0.3 - beams as f32 / 2.0 * step, step };
            let bearing_of =
                |beam: usize| 0.3 + (beam as f64 - beams as f64 / 2.0) * f64::from(step);
            // 2 m away in the direction of 0.8 rad, and on all sides where that is behind.
            let range = |bearing: f64| (2_000.0 / (bearing - 0.8).cos().max(0.4)).min(5_000.0);
            let readings: Vec<u16> =
                (0..beams).map(|beam| range(bearing_of(beam)).round() as u16).collect();
            let table = table(beams, model, Pose::default());
            let columns = Columns::of_scan(&table, &readings, Pose::default(), 64).unwrap();
            assert_eq!(columns.distances.len(), 64);
            // The outermost beams may be before the middle of their columns.
            let columns = bearings(&columns).into_iter().zip(columns.distances);
            for (bearing, units) in columns.take(63).skip(1) {
                let off = f64::from(units) * 20.0 - range(bearing.to_radians());
                assert!(off.abs() < 13.0, "{beams} beams, {bearing} degrees: {off} mm off");
            }
        }
    }

    /// Beyond an edge nothing is interpolated.
    #[test]
    fn an_edge_stays_sharp() {
        let step = core::f32::consts::TAU / 360.0;
        let table = table(360, SensorModel::Radial { first: 0.3, step }, Pose::default());
        let readings: Vec<u16> =
            (0..360).map(|beam| if beam % 90 < 30 { 1_000 } else { 2_000 }).collect();
        let columns = Columns::of_scan(&table, &readings, Pose::default(), 64).unwrap();
        assert!(columns.distances.iter().all(|it| [50, 100].contains(it)), "{columns:?}");
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
