//! From the evidence of an image to cells: free, occupied, movable, or not seen.

use ubimap_protocol::tile::Cell;

use super::{evidence::Evidence, view::View};

/// Fewer pixels than this prove nothing: mixed pixels at the edges of things lie anywhere between
/// the edge and what is behind it, yet seldom several over one cell.
pub(super) const FEWEST: u32 = 4;

/// The cells that an image shows, in the order of rows from the south-west. `movable` says which
/// cells something takes up that stands out of the empty room, and cells `under` a robot are left
/// out. `said` are the cells that were last said to be occupied.
///
/// With `F` pixels that have learnt a cell's floor, `B` that have learnt what is in the way over it,
/// `f` and `b` that see it now, and `e` that would see its floor if nothing stood in between, the
/// cell is solid if `B` >= 4, `B` >= `F`, and 3 `B` >= the same number of each of the four nearest
/// cells on the line of sight: noise smears a wall along that line, and the wall is where most of it
/// is. It is
///
/// 1. movable if something that stands out takes it up;
/// 2. occupied if it is solid and 2 `b` >= `B`;
/// 3. free if 2 `f` >= `e` and `f` >= 2;
/// 4. unknown, which takes back what this camera said, if it was occupied and is no longer solid;
/// 5. else not seen.
pub(super) fn cells(
    view: &View,
    totals: &[u32],
    evidence: &Evidence,
    movable: &[bool],
    under: &[bool],
    said: &mut [bool],
) -> Vec<((i32, i32), Cell)> {
    let foot = view.foot();
    let mut code = |cell: usize| {
        let (floor, band) = evidence.pixels(cell);
        let solid = totals[2 * cell + 1];
        let is_solid =
            solid >= FEWEST && solid >= totals[2 * cell] && is_ridge(view, totals, foot, cell);
        if under[cell] {
            return None;
        }
        let code = if movable[cell] {
            return Some(Cell::Movable);
        } else if is_solid && 2 * band >= solid {
            Cell::Occupied
        } else if floor >= 2 && 2 * floor >= view.expected(cell) {
            Cell::Free
        } else if said[cell] && !is_solid {
            Cell::Unknown
        } else {
            return None;
        };
        said[cell] = code == Cell::Occupied;
        Some(code)
    };
    (0..view.cells()).filter_map(|cell| Some((view.in_map(cell), code(cell)?))).collect()
}

/// Whether none of the two cells before and the two behind has more than three times as much in
/// the way.
fn is_ridge(view: &View, totals: &[u32], foot: (i32, i32), cell: usize) -> bool {
    let band = totals[2 * cell + 1];
    let (x, y) = view.in_map(cell);
    let way = (x - foot.0, y - foot.1);
    let longest = way.0.abs().max(way.1.abs()).max(1);
    // To the nearest cell, halves away from zero.
    let along = |way: i32, steps: i32| {
        (2 * way * steps + way.signum() * steps.signum() * longest) / (2 * longest)
    };
    [-2, -1, 1, 2].into_iter().all(|steps| {
        let beside = (x + along(way.0, steps), y + along(way.1, steps));
        view.index(beside).is_none_or(|beside| totals[2 * beside + 1] <= 3 * band)
    })
}
