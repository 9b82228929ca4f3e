//! Which floor is visible from a point under the ceiling, past walls and furniture.

use ubimap_protocol::tile::Cell;

use super::{
    floor_plan::{Enclosure, FloorPlan},
    obstacle::Obstacle,
};

/// The floor visible from one point, in all directions.
pub(super) struct Sight<'p> {
    plan: &'p FloorPlan,
    eye: [f64; 3],
    /// The obstacles that are near enough to hide floor.
    obstacles: Vec<&'p Obstacle>,
}

impl<'p> Sight<'p> {
    /// The view from a point of `map`, in metres, up to a horizontal distance of `reach_m`.
    pub(super) fn new(plan: &'p FloorPlan, eye: [f64; 3], reach_m: f64) -> Self {
        let is_near = |obstacle: &&Obstacle| {
            let [low, high] = obstacle.bounds();
            (0..2).all(|axis| low[axis] <= eye[axis] + reach_m && eye[axis] - reach_m <= high[axis])
        };
        Self { plan, eye, obstacles: plan.obstacles().iter().filter(is_near).collect() }
    }

    /// The cells within reach whose aim points are visible.
    pub(super) fn cells(&self, reach_m: f64) -> Vec<u32> {
        let [x, y, _] = self.eye;
        let within = self.plan.cells_within([x - reach_m, y - reach_m], [x + reach_m, y + reach_m]);
        let is_seen = |cell: &usize| self.sees(self.plan.cells()[*cell].aim_m);
        within.filter(is_seen).map(|cell| cell as u32).collect()
    }

    fn sees(&self, floor: [f64; 2]) -> bool {
        let [x, y, _] = self.eye;
        let is_behind_wall = match self.plan.enclosure() {
            Enclosure::Map(map) => {
                let walled = |column, row| map.cell(column, row) == Cell::Occupied;
                !is_clear(map.from_map([x, y]), map.from_map(floor), walled)
            }
            // The walls of an outline are obstacles.
            Enclosure::Outline(_) => false,
        };
        !is_behind_wall && !self.obstacles.iter().any(|it| it.hides(self.eye, floor))
    }
}

/// Whether the straight line between two points crosses no walled square of a grid (Amanatides and
/// Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing"). Lengths are in squares; there are no
/// walls outside of the grid.
fn is_clear(from: [f64; 2], to: [f64; 2], walled: impl Fn(usize, usize) -> bool) -> bool {
    let way = [to[0] - from[0], to[1] - from[1]];
    let mut square = from.map(|it| it.floor() as i64);
    let last = to.map(|it| it.floor() as i64);
    let direction = way.map(|it| if it > 0.0 { 1 } else { -1 });
    // The fraction of the segment between two grid lines, and before the next grid line.
    let each = way.map(|it| if it == 0.0 { f64::INFINITY } else { 1.0 / it.abs() });
    let mut next = [0, 1].map(|axis| {
        let ahead = if way[axis] > 0.0 { 1.0 } else { 0.0 };
        let apart = (square[axis] as f64 + ahead - from[axis]).abs();
        if each[axis].is_finite() { apart * each[axis] } else { f64::INFINITY }
    });
    let count = (last[0] - square[0]).abs() + (last[1] - square[1]).abs();
    for _ in 0..=count {
        let is_walled = match square.map(usize::try_from) {
            [Ok(column), Ok(row)] => walled(column, row),
            _ => false,
        };
        if is_walled {
            return false;
        }
        let axis = usize::from(next[1] < next[0]);
        square[axis] += direction[axis];
        next[axis] += each[axis];
    }
    true
}
