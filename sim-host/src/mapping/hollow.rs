//! Reduces fixed objects to their surfaces: only those cells of a wall or a cupboard are published
//! that an observer can have seen.

use ubimap_protocol::tile::{Cell, TILE_CELLS, TILE_SIDE, Tile};

use super::{fused_layer::MapTime, mask::Mask, robot_layer::SeenTile};

/// Maximum distance of a published fixed cell from a free cell, in cells. A deeper cell can't have
/// been seen: it comes from the noise of distant readings behind a wall, or was seen from above.
const MAX_DEPTH: usize = 3;
/// Maximum distance if there are other fixed cells between the cell and the free one. Isolated
/// cells may be deeper: a lidar with few beams draws distant walls without free cells next to them.
const SOLID_DEPTH: usize = 2;

/// The cells of a fused tile whose state is from the cameras. A cell is in view if cameras saw it
/// in the current or the previous step of the map's time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sight {
    /// Free and in view.
    free: Mask,
    /// Free when last in view, but no longer in view.
    lost: Mask,
    /// Fixed and in view.
    fixed: Mask,
}

impl Sight {
    /// The sight of the tile `fused`, to which `cameras` contributed.
    pub fn of(fused: &Tile, cameras: &SeenTile, time: MapTime) -> Self {
        let mut sight = Self::default();
        for cell in 0..usize::from(TILE_CELLS) {
            let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
            let code = fused.cell(x, y);
            let mask = match (code, time.is_recent(cameras.seconds[cell])) {
                _ if cameras.tile.cell(x, y) != code => continue,
                (Cell::Free, true) => &mut sight.free,
                (Cell::Free, false) => &mut sight.lost,
                (Cell::Occupied, true) => &mut sight.fixed,
                _ => continue,
            };
            mask[y] |= 1 << x;
        }
        sight
    }

    /// Whether all three sets are empty, so that no cell can go out of view later.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }
}

/// Removes the fixed cells of a fused tile that are too deep inside an object to be seen.
/// `beside(east, north)` returns the fused neighbour at that offset in tiles, with its sight. The
/// border of free ground does not change. A fixed cell stays if it is
///
/// 1. next to a free cell;
/// 2. one cell behind such a cell, except where cameras see the free ground up to the object's
///    edge: there the cameras locate the surface, and cells behind it are noise of other sensors;
/// 3. up to three cells from a free cell, with nothing fixed in between.
///
/// For fixed cells that cameras see, free cells that are out of view do not count: they were seen
/// before the object came, and are below or behind it. Works on whole words, with a few dozen
/// operations per row.
pub fn hollow<'t>(
    tile: &mut Tile,
    sight: &Sight,
    beside: impl Fn(i16, i16) -> Option<(&'t Tile, &'t Sight)>,
) {
    let whole = *tile;
    let near: [Option<(&Tile, &Sight)>; 9] = core::array::from_fn(|at| match at as i16 {
        4 => Some((&whole, sight)),
        at => beside(at % 3 - 1, at / 3 - 1),
    });
    let free = about(&near, |tile, _, y| tile.low[y] & !tile.high[y]);
    let front = about(&near, |tile, sight, y| tile.low[y] & !tile.high[y] & !sight.lost[y]);
    let bounds = about(&near, |_, sight, y| sight.free[y]);
    let fixed = about(&near, |tile, _, y| tile.high[y] & !tile.low[y]);
    let seen = about(&near, |_, sight, y| sight.fixed[y]);
    // Fixed cells within `steps` cells of the free ground in front of them.
    let within = |at: usize, steps: usize| {
        let close = |rows: &Rows| spread(&rows[at - steps..=at + steps], steps);
        fixed[at] & (close(&free) & !seen[at] | close(&front) & seen[at])
    };
    let (mut first, mut bounded) = ([0; ROWS], [0; ROWS]);
    for at in 1..ROWS - 1 {
        first[at] = within(at, 1);
        bounded[at] = first[at] & spread(&bounds[at - 1..=at + 1], 1);
    }
    // The second layer (cells behind the first one), and the cells of both layers that stay.
    let (mut second, mut kept) = ([0; ROWS], [0; ROWS]);
    for at in 2..ROWS - 2 {
        let behind = |open: fn(u64, u64) -> u64| {
            let rows: [u64; 3] =
                core::array::from_fn(|row| open(first[at + row - 1], bounded[at + row - 1]));
            spread(&rows, 1)
        };
        second[at] = fixed[at] & behind(|first, _| first);
        let open = behind(|first, bounded| first & !bounded) | !second[at];
        kept[at] = first[at] | within(at, SOLID_DEPTH) & open;
    }
    for y in 0..TILE_SIDE {
        let at = y + MAX_DEPTH;
        let alone = within(at, MAX_DEPTH) & !spread(&second[at - 1..=at + 1], 1);
        let mut row = tile.row(y);
        row.high &= row.low | ((kept[at] | alone) >> MAX_DEPTH) as u32;
        tile.set_row(y, row);
    }
}

/// Rows of the tile and of its neighbours that are examined.
const ROWS: usize = TILE_SIDE + 2 * MAX_DEPTH;

/// Each row starts [`MAX_DEPTH`] cells west of the tile.
type Rows = [u64; ROWS];

/// Collects the rows from three by three tiles, starting with the south-western one.
fn about(near: &[Option<(&Tile, &Sight)>; 9], row: impl Fn(&Tile, &Sight, usize) -> u32) -> Rows {
    core::array::from_fn(|index| {
        let y = (index + TILE_SIDE - MAX_DEPTH) % TILE_SIDE;
        let north = usize::from(index >= MAX_DEPTH) + usize::from(index >= TILE_SIDE + MAX_DEPTH);
        let of = |east: usize| {
            near[3 * north + east].map_or(0, |(tile, sight)| u64::from(row(tile, sight, y)))
        };
        of(0) >> (TILE_SIDE - MAX_DEPTH) | of(1) << MAX_DEPTH | of(2) << (TILE_SIDE + MAX_DEPTH)
    })
}

/// The columns within `steps` of a cell in these rows.
fn spread(rows: &[u64], steps: usize) -> u64 {
    let columns = rows.iter().fold(0, |sum, row| sum | row);
    (0..=2 * steps).fold(0, |sum, step| sum | columns << steps >> step)
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::time::Instant;

    use super::*;
    use Cell::{Free, Movable, Occupied, Unknown};

    const SIDE: i32 = TILE_SIDE as i32;

    /// The tile at this offset in tiles; `code` returns the state of each cell.
    fn tile(east: i32, north: i32, code: impl Fn(i32, i32) -> Cell) -> Tile {
        let mut tile = Tile::UNKNOWN;
        for (x, y) in (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y))) {
            tile.set(x as usize, y as usize, code(east * SIDE + x, north * SIDE + y));
        }
        tile
    }

    fn about(x: i32, y: i32, steps: usize) -> impl Iterator<Item = (i32, i32)> {
        let reach = -(steps as i32)..=steps as i32;
        reach.clone().flat_map(move |dy| reach.clone().map(move |dx| (x + dx, y + dy)))
    }

    /// The state of a cell, whether cameras set it, and whether it is in view.
    #[derive(Clone, Copy, PartialEq, Eq)]
    struct Said {
        code: Cell,
        by_cameras: bool,
        in_sight: bool,
    }

    /// Whether the fixed cell at (x, y) stays: the three rules, applied to one cell.
    fn stays(of: impl Fn(i32, i32) -> Said, x: i32, y: i32) -> bool {
        let is_fixed = |x, y| of(x, y).code == Occupied;
        let is_seen = |x, y| of(x, y).by_cameras && of(x, y).in_sight;
        let is_near = |x, y, steps| {
            about(x, y, steps).any(|(east, north)| {
                let Said { code, by_cameras, in_sight } = of(east, north);
                code == Free && !(is_seen(x, y) && by_cameras && !in_sight)
            })
        };
        let is_first = |x, y| is_fixed(x, y) && is_near(x, y, 1);
        let is_bounded = |x, y| about(x, y, 1).any(|(x, y)| of(x, y).code == Free && is_seen(x, y));
        let is_second =
            |x: i32, y: i32| is_fixed(x, y) && about(x, y, 1).any(|(x, y)| is_first(x, y));
        let mut firsts = about(x, y, 1).filter(|&(x, y)| is_first(x, y)).peekable();
        let may_stay = firsts.peek().is_none() || firsts.any(|(x, y)| !is_bounded(x, y));
        is_near(x, y, 1)
            || is_near(x, y, SOLID_DEPTH) && may_stay
            || is_near(x, y, MAX_DEPTH) && !about(x, y, 1).any(|(x, y)| is_second(x, y))
    }

    #[test]
    fn cells_deep_inside_things_are_removed() {
        // Three by three tiles of pseudo-random cells.
        let hash = |x: i32, y: i32, of: i32| (x * 73 + y * 151 + x * y * 31).rem_euclid(of);
        let code = |x: i32, y: i32| match hash(x, y, 97) {
            0..=1 => Free,
            2 => Movable,
            3..=9 => Unknown,
            _ => Occupied,
        };
        let now = MapTime::at(Instant(60_000_000));
        for (by_some, missing) in
            [(1, None), (7, None), (3, Some((1, 0))), (2, Some((-1, -1))), (1, Some((0, 1)))]
        {
            let said = |x: i32, y: i32| Said {
                code: code(x, y),
                by_cameras: hash(y, x, 101) % by_some == 0,
                in_sight: hash(x, y, 5) > 1,
            };
            let tiles: Vec<(Tile, Sight)> = (0..9)
                .map(|at| {
                    let (east, north) = (at % 3 - 1, at / 3 - 1);
                    let cameras = |x, y| {
                        let said = said(x, y);
                        if said.by_cameras { said.code } else { Unknown }
                    };
                    let mut seen =
                        SeenTile { tile: tile(east, north, cameras), ..SeenTile::NOTHING };
                    for (cell, second) in (0..).zip(&mut seen.seconds) {
                        let (x, y) = (east * SIDE + cell % SIDE, north * SIDE + cell / SIDE);
                        *second = if said(x, y).in_sight { 50 } else { 49 };
                    }
                    let whole = tile(east, north, code);
                    (whole, Sight::of(&whole, &seen, now))
                })
                .collect();
            let (mut hollowed, sight) = tiles[4];
            hollow(&mut hollowed, &sight, |east, north| {
                let (tile, sight) = &tiles[(4 + east + 3 * north) as usize];
                (missing != Some((east, north))).then_some((tile, sight))
            });
            let of = |at: i32| i16::from(at >= SIDE) - i16::from(at < 0);
            let there = |x: i32, y: i32| match said(x, y) {
                said if missing != Some((of(x), of(y))) => said,
                said => Said { code: Unknown, ..said },
            };
            let mut out = 0;
            for (x, y) in (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y))) {
                let is_deep = code(x, y) == Occupied && !stays(there, x, y);
                let expected = if is_deep { Unknown } else { code(x, y) };
                assert_eq!(hollowed.cell(x as usize, y as usize), expected, "{x} {y}");
                out += u32::from(is_deep);
            }
            assert!((100..900).contains(&out), "{out}");
        }
    }

    /// The published states of columns, counted from the west, for these columns in all robots'
    /// layers and these camera columns with the second at which they were seen.
    fn columns(robots: &[Cell], cameras: &[(Cell, u32)]) -> Vec<Cell> {
        let of = |x: i32| cameras.get(x as usize).copied().unwrap_or((Unknown, 0));
        let mut seen = SeenTile { tile: tile(0, 0, |x, _| of(x).0), ..SeenTile::NOTHING };
        for (cell, second) in (0..).zip(&mut seen.seconds) {
            *second = of(cell % SIDE).1;
        }
        let mut whole = seen.tile;
        let drawn = tile(0, 0, |x, _| robots.get(x as usize).copied().unwrap_or_default());
        whole.fill_unknown_from(&drawn);
        let sight = Sight::of(&whole, &seen, MapTime::at(Instant(60_000_000)));
        hollow(&mut whole, &sight, |_, _| None);
        (0..robots.len()).map(|x| whole.cell(x, 9)).collect()
    }

    #[test]
    fn a_wall_behind_visible_floor_is_one_cell_thick() {
        let drawn = [Free, Free, Occupied, Occupied, Occupied];
        assert_eq!(columns(&drawn, &[]), [Free, Free, Occupied, Occupied, Unknown]);
        let floor = [(Free, 59), (Free, 59)];
        assert_eq!(columns(&drawn, &floor), [Free, Free, Occupied, Unknown, Unknown]);
        // Much later, the cameras' view has expired.
        let floor = [(Free, 40), (Free, 40)];
        assert_eq!(columns(&drawn, &floor), [Free, Free, Occupied, Occupied, Unknown]);
    }

    #[test]
    fn floor_under_a_new_thing_does_not_expose_its_top() {
        let drawn = [Free; 5];
        let top =
            |second| [(Free, 59), (Occupied, 59), (Occupied, 59), (Occupied, 59), (Free, second)];
        assert_eq!(columns(&drawn, &top(59))[1..4], [Occupied, Unknown, Occupied]);
        assert_eq!(columns(&drawn, &top(49))[1..4], [Occupied, Unknown, Unknown]);
    }
}
