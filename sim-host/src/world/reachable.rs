//! The ground that robots can stand on.

use std::collections::BTreeSet;

use parry2d_f64::glamx::DVec2;

use super::{
    room::{CellGrid, Room},
    route::Body,
};

/// The cells that a robot can cover on its way from a start. `radius`, `room_about` (the clearance) and
/// `height` are in metres; the robot's centre moves from cell to cell and keeps its radius plus the
/// clearance from the room and from the `standing` bodies.
pub(super) fn ground(
    room: &Room,
    cells: CellGrid,
    starts: impl Iterator<Item = DVec2>,
    standing: &[Body],
    [radius, room_about, height]: [f64; 3],
) -> Vec<(i32, i32)> {
    let reach = (radius / cells.side) as i32;
    let disc: Vec<(i32, i32)> = (-reach..=reach)
        .flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy)))
        .filter(|&(dx, dy)| f64::from(dx).hypot(f64::from(dy)) * cells.side <= radius)
        .collect();
    let mut seen = BTreeSet::new();
    let mut ground = BTreeSet::new();
    let mut queue: Vec<(i32, i32)> = starts.map(|start| cells.cell_at(start)).collect();
    let apart = radius + room_about;
    let is_taken =
        |at: DVec2| standing.iter().any(|body| body.centre.distance(at) < body.radius + apart);
    while let Some(cell) = queue.pop() {
        let at = cells.centre(cell);
        if cells.index(cell).is_none()
            || !seen.insert(cell)
            || is_taken(at)
            || room.obstacle(at, at, apart, height).is_some()
        {
            continue;
        }
        let (x, y) = cell;
        ground.extend(disc.iter().map(|(dx, dy)| (x + dx, y + dy)));
        queue.extend([(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]);
    }
    ground.into_iter().collect()
}
