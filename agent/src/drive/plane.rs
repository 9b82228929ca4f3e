//! Bit planes of 64 x 64 cells, one word per row, so that each operation processes a whole row.

/// Side of a window, in cells.
pub const SIDE: usize = 64;

/// A cell of a window, relative to its south-western corner.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Place {
    /// Column, towards the east, below [`SIDE`].
    pub x: u8,
    /// Row, towards the north, below [`SIDE`].
    pub y: u8,
}

impl Place {
    /// The cell in column `x` and row `y`, or `None` outside the window.
    pub fn new(x: i32, y: i32) -> Option<Self> {
        let along = |it: i32| u8::try_from(it).ok().filter(|&it| usize::from(it) < SIDE);
        Some(Self { x: along(x)?, y: along(y)? })
    }

    /// Column and row.
    pub fn column_and_row(self) -> (i32, i32) {
        (self.x.into(), self.y.into())
    }
}

/// A set of cells of a window (512 bytes): bit `x` of row `y`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plane([u64; SIDE]);

impl Plane {
    /// The empty set.
    pub const EMPTY: Self = Self([0; SIDE]);
    /// A row without its outermost cells.
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

    /// Whether the set contains a cell.
    #[inline(always)]
    pub fn has(&self, place: Place) -> bool {
        half(self.row(place.y.into()), place.x) >> (place.x % 32) & 1 != 0
    }

    #[inline(always)]
    pub(super) fn insert(&mut self, place: Place) {
        *self.row_mut(place.y.into()) |= bit(place.x);
    }

    /// Whether the set is empty.
    pub fn is_empty(&self) -> bool {
        self.0.iter().all(|&row| row == 0)
    }

    /// Number of cells.
    pub fn len(&self) -> u32 {
        self.0.iter().map(|row| row.count_ones()).sum()
    }

    /// The cells of the set, row by row from the south-west.
    pub fn cells(&self) -> impl Iterator<Item = Place> {
        let rows = self.0.iter().zip(0u8..);
        rows.flat_map(|(&row, y)| {
            let rest = core::iter::successors(Some(row), |row| Some(row & row.wrapping_sub(1)));
            rest.take_while(|&row| row != 0)
                .map(move |row| Place { x: row.trailing_zeros() as u8, y })
        })
    }

    /// Extends the set to all cells of `within` that are connected to it by their sides.
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

    /// Extends the set by one step to adjacent cells of `within`: across sides, and with `corners`
    /// across corners too.
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

/// Adds the cells of `mask` that are connected to this row or to its neighbour row. Returns whether
/// any were new.
#[inline(always)]
fn spread(row: &mut u64, neighbour: u64, mask: u64) -> bool {
    let seeds = (*row | neighbour) & mask;
    if seeds == *row {
        return false;
    }
    *row = filled(seeds, mask);
    true
}

/// The runs of consecutive set bits of `mask` that contain a seed.
#[inline(always)]
fn filled(seeds: u64, mask: u64) -> u64 {
    // A carry propagates through each run from its first seed.
    let up = |seeds: u64, mask: u64| mask & (mask ^ mask.wrapping_add(seeds)) | seeds;
    up(seeds, mask) | up(seeds.reverse_bits(), mask.reverse_bits()).reverse_bits()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    fn plane() -> impl Strategy<Value = Plane> {
        // On average, three of eight cells are set.
        prop::collection::vec((any::<u64>(), any::<u64>(), any::<u64>()), SIDE)
            .prop_map(|rows| Plane(core::array::from_fn(|y| rows[y].0 | rows[y].1 & rows[y].2)))
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn a_flood_fills_the_connected_cells(within in plane(), x in 0i32..64, y in 0i32..64) {
            let start = Place::new(x, y).unwrap();
            prop_assume!(within.has(start));
            let mut flooded = Plane::EMPTY;
            flooded.insert(start);
            flooded.flood(&within);
            // Reference: cell by cell.
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
        fn cells_lists_the_cells_that_has_reports(plane in plane()) {
            let cells = plane.cells().collect::<Vec<_>>();
            prop_assert_eq!(cells.len() as u32, plane.len());
            prop_assert!(cells.iter().all(|&place| plane.has(place)));
            prop_assert!(cells.windows(2).all(|it| (it[0].y, it[0].x) < (it[1].y, it[1].x)));
        }
    }
}
