//! Polygons in `map`, in metres.

use std::ops::Range;

/// Coordinates beyond this many metres are a mistake.
const FARTHEST_M: f64 = 10_000.0;

/// The cells that points cover along an axis (0 or 1), for cells of this side in metres. `None` if a
/// coordinate is not finite, or absurd.
pub(crate) fn span(points: &[[f64; 2]], axis: usize, side_m: f64) -> Option<Range<i32>> {
    let along = || points.iter().map(|point| point[axis]);
    if !along().all(|metres| metres.abs() <= FARTHEST_M) {
        return None;
    }
    let first = along().fold(f64::INFINITY, f64::min) / side_m;
    let last = along().fold(f64::NEG_INFINITY, f64::max) / side_m;
    Some(first.floor() as i32..last.ceil() as i32)
}

/// Whether a point lies in a polygon: a ray to the east crosses its edges an odd number of times.
pub(crate) fn is_inside(corners: &[[f64; 2]], [x, y]: [f64; 2]) -> bool {
    let next = corners.iter().cycle().skip(1);
    let crosses = corners.iter().zip(next).filter(|([ax, ay], [bx, by])| {
        (*ay > y) != (*by > y) && x < ax + (y - ay) / (by - ay) * (bx - ax)
    });
    crosses.count() % 2 == 1
}
