//! Landmarks that move: one place of a marker, seen by several cameras at different times.

use std::collections::BTreeMap;

use nalgebra::Point3;
use ubimap_protocol::time::{Duration, Instant};

/// Interval of the moments to which positions are interpolated.
const INTERVAL: Duration = Duration::from_millis(100);
/// Maximum time between the sightings around a moment. A robot that brakes with 0.5 m/s^2 is at most
/// 3 mm off the straight line.
const GAP: Duration = Duration::from_millis(210);
/// Minimum distance between two places in metres.
const APART_M: f64 = 0.03;

/// The sightings of one marker by one camera: time and position in the camera's optical frame, in
/// metres.
pub(super) type Trail = BTreeMap<Instant, Point3<f64>>;

/// The moments at which several cameras see a marker at a place where it has not been just before,
/// with its position in the frame of each of these cameras. `trails` are those of one marker, by the
/// camera's index.
pub(super) fn places(
    trails: &BTreeMap<usize, Trail>,
) -> Vec<(Instant, BTreeMap<usize, Point3<f64>>)> {
    let first = trails.values().filter_map(|trail| trail.keys().next()).min();
    let last = trails.values().filter_map(|trail| trail.keys().next_back()).max();
    let (Some(first), Some(last)) = (first, last) else { return Vec::new() };
    let mut places: Vec<(Instant, BTreeMap<usize, Point3<f64>>)> = Vec::new();
    let mut moment = Instant(first.0.next_multiple_of(INTERVAL.0));
    while moment <= *last {
        let seen = trails.iter().filter_map(|(&camera, trail)| Some((camera, at(trail, moment)?)));
        let seen: BTreeMap<usize, Point3<f64>> = seen.collect();
        let before = places.last().map(|(_, before)| before);
        if seen.len() > 1 && before.is_none_or(|before| has_moved(before, &seen)) {
            places.push((moment, seen));
        }
        moment = moment + INTERVAL;
    }
    places
}

/// The position at a moment, between the sightings before and after it.
fn at(trail: &Trail, moment: Instant) -> Option<Point3<f64>> {
    let (before, from) = trail.range(..=moment).next_back()?;
    let (after, to) = trail.range(moment..).next()?;
    let gap = after.since(*before);
    if gap > GAP {
        return None;
    }
    let part = moment.since(*before).micros() as f64 / gap.micros().max(1) as f64;
    Some(from + (to - from) * part)
}

/// Whether all cameras that see a marker at both places have seen it move.
fn has_moved(before: &BTreeMap<usize, Point3<f64>>, seen: &BTreeMap<usize, Point3<f64>>) -> bool {
    let mut ways = seen.iter().filter_map(|(camera, at)| Some((at - before.get(camera)?).norm()));
    ways.all(|way_m| way_m >= APART_M)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sightings of a marker that moves along x with 0.4 m/s, from `first_ms` on.
    fn trail(first_ms: u64, interval_ms: u64, count: u64) -> Trail {
        let times = (0..count).map(|index| first_ms + interval_ms * index);
        let seen = |ms| (Instant(1000 * ms), Point3::new(0.0004 * ms as f64, 1.0, 2.0));
        times.map(seen).collect()
    }

    #[test]
    fn positions_are_those_of_one_moment() {
        let trails = BTreeMap::from([(0, trail(5, 66, 30)), (3, trail(40, 70, 30))]);
        let places = places(&trails);
        assert_eq!(places.len(), 19);
        for (moment, seen) in places {
            let x = 0.4 * moment.micros() as f64 / 1e6;
            assert_eq!(seen.len(), 2);
            assert!(seen.values().all(|at| (at - Point3::new(x, 1.0, 2.0)).norm() < 1e-9));
        }
    }

    #[test]
    fn gaps_and_standing_markers_give_no_places() {
        let gap = BTreeMap::from([(0, trail(0, 66, 30)), (1, trail(0, 300, 8))]);
        // Only where both have just seen it.
        assert!(places(&gap).iter().all(|(moment, _)| moment.micros() % 300_000 == 0));
        let standing = |trail: Trail| trail.into_keys().map(|at| (at, Point3::origin())).collect();
        let trails =
            BTreeMap::from([(0, standing(trail(0, 66, 30))), (1, standing(trail(0, 66, 30)))]);
        assert_eq!(places(&trails).len(), 1);
        assert!(places(&BTreeMap::new()).is_empty());
        assert!(places(&BTreeMap::from([(0, trail(0, 66, 30))])).is_empty());
    }
}
