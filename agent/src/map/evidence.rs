//! What speaks for and against each cell: a saturating counter of three bits, in planes, so that
//! a row of 32 cells is updated by a handful of logic instructions.
//!
//! 0 is unknown, 1 to 3 free, 4 to 7 occupied. A hit counts up by one, a near hit by two, a cell
//! that beams crossed counts down by one. An unknown cell starts at 3 if it was crossed, and at 5
//! (6 if near) if it was hit: a hit says more than a beam that passed by.
//!
//! What the server's map says already is not counted again: where it agrees with what is seen,
//! the cell stays unknown here; where it does not, the cell starts from what the map says, 5 or
//! 1, and must be seen otherwise a few times before this robot contradicts.

use ubimap_protocol::tile::{Row, TILE_SIDE, Tile};

/// The evidence of one tile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Evidence {
    planes: [[u32; TILE_SIDE]; 3],
}

/// What a scan says of one row of a tile; a cell is in at most one of `free` and `hit`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RowSighting {
    /// Cells that beams crossed.
    pub free: u32,
    /// Cells that beams ended in.
    pub hit: u32,
    /// Those of the hits that were near: they count twice.
    pub near: u32,
}

impl Evidence {
    /// Nothing is known of any cell.
    pub const NONE: Self = Self { planes: [[0; TILE_SIDE]; 3] };

    /// Adds what a scan says of row `y` modulo 32, of which the server's map says `known`.
    pub fn add(&mut self, y: usize, sighting: RowSighting, known: Row) {
        let y = y % TILE_SIDE;
        let [p0, p1, p2] = &mut self.planes;
        let mut row = [p0[y], p1[y], p2[y]];
        let new = !(row[0] | row[1] | row[2]);
        let (known_free, known_occupied) = (new & known.low & !known.high, new & known.high);
        let hit = sighting.hit & !known_occupied;
        let free = sighting.free & !sighting.hit & !known_free;
        let from_free = hit & known_free;
        let from_occupied = free & known_occupied;
        row[0] |= from_free | from_occupied;
        row[2] |= from_occupied;
        up(&mut row, hit);
        up(&mut row, hit & sighting.near);
        down(&mut row, free);
        [p0[y], p1[y], p2[y]] = row;
    }

    /// The cells of row `y` modulo 32 of which nothing is known here.
    pub fn unknown(&self, y: usize) -> u32 {
        let y = y % TILE_SIDE;
        !(self.planes[0][y] | self.planes[1][y] | self.planes[2][y])
    }

    /// The cells of row `y` modulo 32 for whose being occupied no further hit can say more.
    pub fn certain(&self, y: usize) -> u32 {
        let y = y % TILE_SIDE;
        self.planes[0][y] & self.planes[1][y] & self.planes[2][y]
    }

    /// What is to be published: unknown, free or occupied.
    pub fn cells(&self) -> Tile {
        let [p0, p1, p2] = &self.planes;
        let mut tile = Tile::UNKNOWN;
        for y in 0..TILE_SIDE {
            tile.low[y] = (p0[y] | p1[y]) & !p2[y];
            tile.high[y] = p2[y];
        }
        tile
    }
}

/// Counts up by one: unknown to 5, 7 stays.
fn up([p0, p1, p2]: &mut [u32; 3], mask: u32) {
    let unknown = !(*p0 | *p1 | *p2) & mask;
    let carry = mask & !unknown & !(*p0 & *p1 & *p2);
    let carry_1 = *p0 & carry;
    *p0 ^= carry;
    let carry_2 = *p1 & carry_1;
    *p1 ^= carry_1;
    *p2 ^= carry_2;
    *p2 |= unknown;
    *p0 |= unknown;
}

/// Counts down by one: unknown to 3, 1 stays.
fn down([p0, p1, p2]: &mut [u32; 3], mask: u32) {
    let unknown = !(*p0 | *p1 | *p2) & mask;
    let borrow = mask & !unknown & !(*p0 & !*p1 & !*p2);
    let borrow_1 = !*p0 & borrow;
    *p0 ^= borrow;
    let borrow_2 = !*p1 & borrow_1;
    *p1 ^= borrow_1;
    *p2 ^= borrow_2;
    *p0 |= unknown;
    *p1 |= unknown;
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use ubimap_protocol::tile::Cell;

    /// The same for one cell, plainly.
    fn count(value: u8, bit: usize, sighting: RowSighting, known: Row) -> u8 {
        let is = |mask: u32| mask >> bit & 1 != 0;
        let up = |value: u8| if value == 0 { 5 } else { (value + 1).min(7) };
        let mut value = value;
        if value == 0 && (is(sighting.hit) || is(sighting.free)) {
            match (is(known.low), is(known.high)) {
                (_, true) if is(sighting.hit) => return 0,
                (_, true) => value = 5,
                (true, false) if !is(sighting.hit) => return 0,
                (true, false) => value = 1,
                (false, false) => {}
            }
        }
        if is(sighting.hit) {
            value = up(value);
            if is(sighting.near) {
                value = up(value);
            }
        } else if is(sighting.free) {
            value = if value == 0 { 3 } else { (value - 1).max(1) };
        }
        value
    }

    proptest! {
        #[test]
        fn planes_count_like_numbers(
            sightings in proptest::collection::vec((any::<u32>(), any::<u32>(), any::<u32>()), 0..30),
            low: u32, high: u32,
            y in 0usize..TILE_SIDE,
        ) {
            let mut evidence = Evidence::NONE;
            let mut plain = [0u8; 32];
            let known = Row { low, high };
            for (free, hit, near) in sightings {
                let sighting = RowSighting { free, hit, near };
                evidence.add(y, sighting, known);
                for (bit, value) in plain.iter_mut().enumerate() {
                    *value = count(*value, bit, sighting, known);
                }
            }
            let cells = evidence.cells();
            for (x, value) in plain.into_iter().enumerate() {
                let expected = match value {
                    0 => Cell::Unknown,
                    1..=3 => Cell::Free,
                    _ => Cell::Occupied,
                };
                prop_assert_eq!(cells.cell(x, y), expected);
                prop_assert_eq!(evidence.certain(y) >> x & 1 != 0, value == 7);
            }
        }
    }
}
