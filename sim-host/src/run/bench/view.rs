//! What a robot sees, from its distance vectors: points around it, and a line across that limits its view.

use ubimap_protocol::{message::DistanceVector, units::Angle};

/// How far points of a flat view may lie before and beyond the place up to which nine in ten lie: their noise, in
/// metres.
const FLAT: [f64; 2] = [0.09, 0.05];
/// Minimum number of points on that line, and share of all points.
const FLAT_POINTS: usize = 6;
const FLAT_SHARE: f64 = 0.4;

/// A point that the robot sees, in `base_link`: metres ahead and to the left.
pub(super) type Point = [f64; 2];

/// A view: its columns, each with a bearing in radians and a distance in metres. Columns without a return are
/// left out.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct View {
    /// Bearing and distance, counter-clockwise.
    pub(super) seen: Vec<(f64, f64)>,
    /// Number of columns, those without a return included.
    pub(super) columns: usize,
    /// The first and the last bearing, in radians.
    pub(super) from_to: [f64; 2],
}

impl View {
    /// The view of a vector.
    pub(super) fn of(vector: &DistanceVector) -> Self {
        let first = signed(vector.first);
        let step = f64::from(vector.step) * std::f64::consts::TAU / 65_536.0;
        let bearing = |index: usize| first + index as f64 * step;
        let columns = vector.distances.len();
        let unit = DistanceVector::UNIT.metres();
        let known = |&(_, code): &(usize, &u8)| *code != 0 && *code != DistanceVector::BEYOND;
        let seen = vector.distances.iter().enumerate().filter(known);
        let seen = seen.map(|(index, code)| (bearing(index), f64::from(*code) * unit));
        let mut seen: Vec<(f64, f64)> = seen.collect();
        if step < 0.0 {
            seen.reverse();
        }
        Self { seen, columns, from_to: [first, bearing(columns.saturating_sub(1))] }
    }

    /// The points.
    pub(super) fn points(&self) -> impl Iterator<Item = Point> {
        self.seen.iter().map(|&(bearing, distance)| {
            [distance * libm::cos(bearing), distance * libm::sin(bearing)]
        })
    }

    /// How far ahead of `base_link` the line across is that limits the view, if it is flat: nothing lies
    /// beyond, and many points lie on it. That is a wall across, or the floor before a sensor that looks down.
    pub(super) fn flat_m(&self) -> Option<f64> {
        let mut ahead: Vec<f64> = self.points().map(|[x, _]| x).filter(|&x| x > 0.0).collect();
        ahead.sort_by(f64::total_cmp);
        let farthest = ahead.len().checked_sub(1)?;
        // The farthest ones but one in ten, which may be outliers.
        let limit = ahead[farthest - farthest / 10];
        let on = |x: f64| (limit - FLAT[0]..=limit + FLAT[1]).contains(&x);
        let line: Vec<f64> = ahead.iter().copied().filter(|&x| on(x)).collect();
        let is_flat =
            line.len() >= FLAT_POINTS && line.len() as f64 >= FLAT_SHARE * self.seen.len() as f64;
        is_flat.then(|| line.iter().sum::<f64>() / line.len() as f64)
    }
}

/// An angle between -180 and 180 degrees, in radians.
pub(super) fn signed(angle: Angle) -> f64 {
    f64::from(angle.0 as i16) * std::f64::consts::TAU / 65_536.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_across_that_limits_the_view_is_flat() {
        let across = |x: f64| {
            let seen = (-30..=30).step_by(3).map(|degree| {
                let bearing = f64::from(degree).to_radians();
                (bearing, (x / bearing.cos() / 0.02).round() * 0.02)
            });
            View { seen: seen.collect(), columns: 21, from_to: [-0.5, 0.5] }
        };
        let flat = across(1.43).flat_m().unwrap();
        assert!((flat - 1.43).abs() < 0.01, "{flat}");
        // Something nearer in a part of it changes nothing, something beyond does.
        let mut part = across(1.43);
        part.seen[..7].iter_mut().for_each(|(_, distance)| *distance = 0.8);
        assert!(part.flat_m().is_some());
        part.seen[..7].iter_mut().for_each(|(_, distance)| *distance = 2.4);
        assert_eq!(part.flat_m(), None);
        assert_eq!(View::default().flat_m(), None);
    }

    #[test]
    fn a_vector_is_read_by_its_bearings() {
        let vector = DistanceVector {
            time: ubimap_protocol::time::Instant(0),
            pose: ubimap_protocol::units::Pose::default(),
            first: Angle::from_degrees(-90.0),
            step: 16_384,
            distances: [50, 0, 255, 100].into_iter().collect(),
            odometry: None,
        };
        let view = View::of(&vector);
        let degrees: Vec<_> =
            view.seen.iter().map(|(it, m)| (it.to_degrees().round(), *m)).collect();
        assert_eq!((view.columns, degrees), (4, vec![(-90.0, 1.0), (180.0, 2.0)]));
    }
}
