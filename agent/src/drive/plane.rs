//! 64 x 64 cells, one bit each, a word for each row: what is done to one cell is done to a row.

/// Cells along a side of a window.
pub const SIDE: usize = 64;

/// A cell of a window, from its south-western corner.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Place {
    /// To the east, below [`SIDE`].
    pub x: u8,
    /// To the north, below [`SIDE`].
    pub y: u8,
}

impl Place {
    /// The cell so many columns and rows from the corner, if that is within the window.
    pub fn new(x: i32, y: i32) -> Option<Self> {
        let along = |it: i32| u8::try_from(it).ok().filter(|&it| usize::from(it) < SIDE);
        Some(Self { x: along(x)?, y: along(y)? })
    }

    /// Column and row.
    pub fn column_and_row(self) -> (i32, i32) {
        (self.x.into(), self.y.into())
    }
}

/// One bit for each cell of a window (512 bytes): bit `x` of row `y`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plane([u64; SIDE]);

impl Plane {
    /// No cell.
    pub const EMPTY: Self = Self([0; SIDE]);
    /// All but the outermost cells.
    pub(super) const INNER: u64 = u64::MAX >> 2 << 1;

    /// Row `y`, modulo 64.
    #[inline(always)]
    pub fn row(&self, y: usize) -> u64 {
        self.0[y % SIDE]
    }

    /// Row `y`, modulo 64.
    #[inline(always)]
    pub(super) fn row_mut(&mut self, y: usize) -> &mut u64 {
        &mut self.0[y % SIDE]
    }

    /// Whether a cell is in it.
    #[inline(always)]
    pub fn has(&self, place: Place) -> bool {
        half(self.row(place.y.into()), place.x) >> (place.x % 32) & 1 != 0
    }

    #[inline(always)]
    pub(super) fn insert(&mut self, place: Place) {
        *self.row_mut(place.y.into()) |= bit(place.x);
    }

    /// Whether no cell is in it.
    pub fn is_empty(&self) -> bool {
        self.0.iter().all(|&row| row == 0)
    }

    /// How many cells are in it.
    pub fn len(&self) -> u32 {
        self.0.iter().map(|row| row.count_ones()).sum()
    }

    /// The cells that are in it, from the south-west.
    pub fn cells(&self) -> impl Iterator<Item = Place> {
        let rows = self.0.iter().zip(0u8..);
        rows.flat_map(|(&row, y)| {
            let rest = core::iter::successors(Some(row), |row| Some(row & row.wrapping_sub(1)));
            rest.take_while(|&row| row != 0)
                .map(move |row| Place { x: row.trailing_zeros() as u8, y })
        })
    }

    /// The cells of `within` that hang together with these by their sides.
    pub(super) fn flood(&mut self, within: &Plane) {
        for (row, &mask) in self.0.iter_mut().zip(&within.0) {
            *row = filled(*row & mask, mask);
        }
        let mut changed = true;
        while changed {
            changed = false;
            let mut last = 0;
            for (row, &mask) in self.0.iter_mut().zip(&within.0) {
                changed |= spread(row, last, mask);
                last = *row;
            }
            last = 0;
            for (row, &mask) in self.0.iter_mut().zip(&within.0).rev() {
                changed |= spread(row, last, mask);
                last = *row;
            }
        }
    }

    /// One step outwards within `within`: over sides, or over corners too.
    pub(super) fn grow(&mut self, within: &Plane, corners: bool) {
        let mut below = 0;
        for y in 0..SIDE {
            let row = self.row(y);
            let above = if y + 1 < SIDE { self.row(y + 1) } else { 0 };
            let vertical = above | below | row;
            let sideways = if corners { vertical } else { row };
            *self.row_mut(y) = (vertical | sideways << 1 | sideways >> 1) & within.row(y);
            below = row;
        }
    }
}

#[inline(always)]
fn half(row: u64, x: u8) -> u32 {
    if x & 32 == 0 { row as u32 } else { (row >> 32) as u32 }
}

#[inline(always)]
fn bit(x: u8) -> u64 {
    let bit = u64::from(1u32 << (x % 32));
    if x & 32 == 0 { bit } else { bit << 32 }
}

/// Adds to a row what its neighbour row and itself reach within `mask`. Whether that was anything.
#[inline(always)]
fn spread(row: &mut u64, neighbour: u64, mask: u64) -> bool {
    let seeds = (*row | neighbour) & mask;
    if seeds == *row {
        return false;
    }
    *row = filled(seeds, mask);
    true
}

/// The stretches of a mask that have a seed.
#[inline(always)]
fn filled(seeds: u64, mask: u64) -> u64 {
    // A carry runs up each stretch from its first seed.
    let up = |seeds: u64, mask: u64| mask & (mask ^ mask.wrapping_add(seeds)) | seeds;
    up(seeds, mask) | up(seeds.reverse_bits(), mask.reverse_bits()).reverse_bits()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    fn plane() -> impl Strategy<Value = Plane> {
        // Two of three cells are in.
        prop::collection::vec((any::<u64>(), any::<u64>(), any::<u64>()), SIDE)
            .prop_map(|rows| Plane(core::array::from_fn(|y| rows[y].0 | rows[y].1 & rows[y].2)))
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn a_flood_fills_what_hangs_together(within in plane(), x in 0i32..64, y in 0i32..64) {
            let start = Place::new(x, y).unwrap();
            prop_assume!(within.has(start));
            let mut flooded = Plane::EMPTY;
            flooded.insert(start);
            flooded.flood(&within);
            // Cell by cell.
            let mut found = Plane::EMPTY;
            let mut todo = Vec::from([start]);
            found.insert(start);
            while let Some(place) = todo.pop() {
                let (x, y) = place.column_and_row();
                for (dx, dy) in [(1, 0), (0, 1), (-1, 0), (0, -1)] {
                    let Some(next) = Place::new(x + dx, y + dy) else { continue };
                    if within.has(next) && !found.has(next) {
                        found.insert(next);
                        todo.push(next);
                    }
                }
            }
            prop_assert_eq!(flooded, found);
        }

        #[test]
        fn the_cells_of_a_plane_are_those_that_it_has(plane in plane()) {
            let cells = plane.cells().collect::<Vec<_>>();
            prop_assert_eq!(cells.len() as u32, plane.len());
            prop_assert!(cells.iter().all(|&place| plane.has(place)));
            prop_assert!(cells.windows(2).all(|it| (it[0].y, it[0].x) < (it[1].y, it[1].x)));
        }
    }
}
