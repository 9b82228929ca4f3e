//! From the evidence of an image to cells: free, occupied, movable, or not seen.

use ubimap_protocol::tile::Cell;

use super::{evidence::Evidence, ray_table::RayTable};

/// Fewer pixels than this prove nothing: mixed pixels at the edges of things lie anywhere between
/// the edge and what is behind it, yet seldom several over one cell.
pub(super) const FEWEST: u32 = 4;
/// So many cells behind what stands on the floor are taken to lie in its shadow: what is 10 cm high
/// and 5 m away from under a ceiling hides as many.
const SHADOW: i32 = 3;

/// The cells that an image shows, in the order of rows from the south-west. `movable` says which
/// cells something takes up that stands out of the empty room, and cells `under` a robot are left
/// out. `said` is what this camera said of each cell last.
///
/// With `F` pixels that have learnt a cell's floor, `B` that have learnt what is in the way over it,
/// `f` and `b` that see it now, and `e` that would see its floor if nothing stood in between, the
/// cell is solid if `B` >= 4, 3 `B` >= the same number of each of the four nearest cells on the line
/// of sight (noise smears a wall along that line, and the wall is where most of it is), and `B` >= `F`
/// or it hides a cell next to it, of which nothing has been learnt though `e` >= 4: of a wall that is
/// seen edge on there are few pixels, and floor before it may take up most of its cell. It is
///
/// 1. movable if something that stands out takes it up, but where the same rule of the pixels that see
///    it does not hold and the floor is seen as in case 4: noise smears it towards the camera;
/// 2. occupied if it is solid and 2 `b` >= `B`;
/// 3. not seen if it is one of the three cells behind one of case 2, on the line of sight: the foot
///    of a wall whose depth is measured too long seems to be floor behind it. If this camera said
///    that it is free, it is unknown from now on;
/// 4. free if 2 `f` >= `e` and `f` >= 2;
/// 5. unknown, which takes back what this camera said, if it was occupied and is no longer solid;
/// 6. else not seen.
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
        solid >= FEWEST
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

/// Whether nothing has been learnt of a cell next to one, although its floor would be seen if what is
/// in the way over the one did not hide it: a wall that is seen edge on, with floor before it.
fn is_edge(rays: &RayTable, totals: &[u32], cell: usize) -> bool {
    let (x, y) = rays.in_map(cell);
    [(1, 0), (0, 1), (-1, 0), (0, -1)]
        .into_iter()
        .filter_map(|(east, north)| rays.index((x + east, y + north)))
        .any(|it| rays.expected(it) >= FEWEST && totals[2 * it] == 0 && totals[2 * it + 1] == 0)
}

/// Whether none of the two cells before and the two behind has more than three times as many pixels
/// of something in the way.
fn is_ridge(rays: &RayTable, pixels: impl Fn(usize) -> u32, foot: (i32, i32), cell: usize) -> bool {
    let most = 3 * pixels(cell);
    [-2, -1, 1, 2]
        .into_iter()
        .all(|steps| on_sight(rays, foot, cell, steps).is_none_or(|beside| pixels(beside) <= most))
}

/// The cell so many steps behind another one on the line of sight, before it if they are negative.
fn on_sight(rays: &RayTable, foot: (i32, i32), cell: usize, steps: i32) -> Option<usize> {
    let (x, y) = rays.in_map(cell);
    let way = (x - foot.0, y - foot.1);
    let longest = way.0.abs().max(way.1.abs()).max(1);
    // To the nearest cell, halves away from zero.
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
    fn a_wall_that_is_seen_edge_on_is_no_floor() {
        let lens = lens(640, 480, [0.2, 0.2, 2.8], [3.0, 2.7, 0.0]);
        let rays = RayTable::new(&lens, &DepthNoise::D435, Survey::default());
        // Its face takes up a fifth of its cells.
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
