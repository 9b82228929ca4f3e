//! People who sat or lay in view while the background was learnt, and are part of it, when they rise.

use super::ray_table::RayTable;
use crate::camera::Thing;

/// The heights of a person who stands, in millimetres; doors are higher.
const HEIGHTS: std::ops::RangeInclusive<u16> = 1_350..=1_950;
/// Maximum ground that a person covers, in square millimetres.
const GROUND_MM2: i64 = 800_000;

/// Whether a new object is somebody who has risen: as high and as wide as a standing person, on ground of
/// which no floor has been learnt for at least half of the cells, as the same person hid it. Anything that
/// came in stands on floor that was seen before. `totals` is the evidence of the background, two numbers
/// for each cell: floor and obstacle.
pub(super) fn has_risen(thing: &Thing, rays: &RayTable, totals: &[u32]) -> bool {
    let side = i64::from(rays.survey().side.0);
    let count = thing.cells.len();
    let cells = || thing.cells.iter().filter_map(|&cell| rays.index(cell));
    HEIGHTS.contains(&thing.top_mm)
        && count as i64 * side * side <= GROUND_MM2
        && 2 * cells().filter(|cell| totals[2 * cell] == 0).count() >= count
}
