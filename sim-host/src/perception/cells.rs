//! Classifies cells from the evidence of an image: free, occupied, movable, or not seen.

use ubimap_protocol::tile::Cell;

use super::{evidence::Evidence, ray_table::RayTable};

/// Minimum number of pixels as evidence: a mixed pixel at an object's edge lies anywhere between the edge
/// and the surface behind, but there are seldom several over one cell.
pub(super) const MIN_EVIDENCE: u32 = 4;
/// Number of cells behind an obstacle that are assumed to be in its shadow: the shadow of an
/// obstacle 10 cm high and 5 m away, seen from a ceiling.
const SHADOW: i32 = 3;

/// Classifies the cells that an image shows, row by row from the south-west. `movable` marks the
/// cells of foreground objects; cells `under` a robot are left out. `said` is the last published
/// code of each cell.
///
/// Let `F` be the number of pixels that have learnt the cell's floor, `B` the number that have learnt an
/// obstacle over it, `f` and `b` the numbers that see these now, and `e` the number that would see the
/// floor if nothing occluded it. The cell is **solid** if
///
/// - `B` >= 4;
/// - it is a ridge: 3 `B` is at least the `B` of each of the four nearest cells on the line of sight
///   (noise smears a wall along that line, and most of its pixels are at the wall); and
/// - `B` >= `F`, or it hides a neighbouring cell with `e` >= 4 and with `F` and `B` both zero: a
///   wall seen edge on has few pixels, and the floor in front may take up most of its cell.
///
/// The code of a cell is the first of these that applies:
///
/// 1. movable if an object covers it, unless the cell is not a ridge of foreground pixels and its floor is
///    seen as in case 4 (noise smears objects towards the camera);
/// 2. occupied if it is solid and 2 `b` >= `B`;
/// 3. not seen if it is one of the three cells behind a cell of case 2, on the line of sight: noise makes
///    the foot of a wall look like floor behind it. If the cell was published as free, it becomes
///    unknown;
/// 4. free if 2 `f` >= `e` and `f` >= 2;
/// 5. unknown if it was published as occupied and is no longer solid;
/// 6. otherwise not seen.
pub(super) fn cells(
    rays: &RayTable,
    totals: &[u32],
    evidence: &Evidence,
    movable: &[bool],
    under: &[bool],
    said: &mut [Cell],
) -> Vec<((i32, i32), Cell)> {
    let foot = rays.foot();
    let is_solid = |cell: usize| {
        let [floor, solid] = [totals[2 * cell], totals[2 * cell + 1]];
        solid >= MIN_EVIDENCE
            && (solid >= floor || is_edge(rays, totals, cell))
            && is_ridge(rays, |it| totals[2 * it + 1], foot, cell)
    };
    let is_floor = |cell: usize| {
        let (floor, _) = evidence.pixels(cell);
        floor >= 2 && 2 * floor >= rays.expected(cell)
    };
    let is_movable = |cell: usize| {
        let is_ridge = || is_ridge(rays, |it| evidence.figure_pixels(it), foot, cell);
        movable[cell] && (!is_floor(cell) || is_ridge())
    };
    let stands =
        |cell: &usize| 2 * evidence.pixels(*cell).1 >= totals[2 * cell + 1] && is_solid(*cell);
    let mut shadow = vec![false; rays.cells()];
    for cell in (0..rays.cells()).filter(stands) {
        for behind in (1..=SHADOW).filter_map(|steps| on_sight(rays, foot, cell, steps)) {
            shadow[behind] = true;
        }
    }
    let mut code = |cell: usize| {
        if under[cell] {
            return None;
        }
        let code = if is_movable(cell) {
            return Some(Cell::Movable);
        } else if stands(&cell) {
            Cell::Occupied
        } else if shadow[cell] {
            if said[cell] != Cell::Free {
                return None;
            }
            Cell::Unknown
        } else if is_floor(cell) {
            Cell::Free
        } else if said[cell] == Cell::Occupied && !is_solid(cell) {
            Cell::Unknown
        } else {
            return None;
        };
        said[cell] = code;
        Some(code)
    };
    (0..rays.cells()).filter_map(|cell| Some((rays.in_map(cell), code(cell)?))).collect()
}

/// Whether nothing has been learnt about a neighbouring cell although its floor would be visible
/// without the obstacle in this cell: a wall seen edge on, with floor in front.
fn is_edge(rays: &RayTable, totals: &[u32], cell: usize) -> bool {
    let (x, y) = rays.in_map(cell);
    [(1, 0), (0, 1), (-1, 0), (0, -1)]
        .into_iter()
        .filter_map(|(east, north)| rays.index((x + east, y + north)))
        .any(|it| {
            rays.expected(it) >= MIN_EVIDENCE && totals[2 * it] == 0 && totals[2 * it + 1] == 0
        })
}

/// Whether none of the two cells before and the two behind on the line of sight has more than three
/// times as many pixels as this cell.
fn is_ridge(rays: &RayTable, pixels: impl Fn(usize) -> u32, foot: (i32, i32), cell: usize) -> bool {
    let most = 3 * pixels(cell);
    [-2, -1, 1, 2]
        .into_iter()
        .all(|steps| on_sight(rays, foot, cell, steps).is_none_or(|beside| pixels(beside) <= most))
}

/// The cell that is `steps` cells behind another one on the line of sight; in front of it if
/// negative.
fn on_sight(rays: &RayTable, foot: (i32, i32), cell: usize, steps: i32) -> Option<usize> {
    let (x, y) = rays.in_map(cell);
    let way = (x - foot.0, y - foot.1);
    let longest = way.0.abs().max(way.1.abs()).max(1);
    // Rounds to the nearest cell, halves away from zero.
    let along =
        |way: i32| (2 * way * steps + way.signum() * steps.signum() * longest) / (2 * longest);
    rays.index((x + along(way.0), y + along(way.1)))
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::time::Instant;

    use super::*;
    use crate::camera::DepthNoise;
    use crate::perception::{
        background::Background,
        ray_table::Survey,
        testing::{lens, noisy, render},
    };

    #[test]
    fn a_wall_seen_edge_on_is_not_floor() {
        let lens = lens(640, 480, [0.2, 0.2, 2.8], [3.0, 2.7, 0.0]);
        let rays = RayTable::new(&lens, &DepthNoise::D435, Survey::default());
        // The wall covers a fifth of the cells along its face.
        let wall = [[-1.0, -0.2, 0.0], [6.0, 0.06, 3.0]];
        let image = render(&lens, 0.0, &[wall]);
        let mut background = Background::new(&rays);
        let free = vec![false; rays.cells()];
        for frame in 0..30 {
            let captured = Instant(frame * 300_000);
            background.learn(&rays, &noisy(&image, &DepthNoise::D435, frame, 980), captured, &free);
        }
        let mut said = vec![Cell::Unknown; rays.cells()];
        let mut evidence = Evidence::default();
        evidence.fuse(&rays, &background, &noisy(&image, &DepthNoise::D435, 99, 980));
        let cells = cells(&rays, background.totals(), &evidence, &free, &free, &mut said);
        let mut walls = 0;
        for ((x, y), cell) in cells.into_iter().filter(|((x, _), _)| (45..60).contains(x)) {
            walls += usize::from(y == 1);
            let expected = if y > 1 { Cell::Free } else { Cell::Occupied };
            assert!(y >= 1 && cell == expected, "{cell:?} at {x}, {y}");
        }
        assert_eq!(walls, 15);
    }
}
