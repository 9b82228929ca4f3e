//! The evidence for each cell: a saturating counter of three bits, stored in bit planes, so that a
//! few logic instructions update a row of 32 cells.
//!
//! 0 is unknown, 1 to 3 free, 4 to 7 occupied. A hit adds one, a near hit two; a crossing by a beam
//! subtracts one. An unknown cell starts at 3 when crossed, and at 5 (6 if near) when hit: a hit is
//! stronger evidence than a crossing.
//!
//! Information already in the server's map is not counted again: where an observation agrees with
//! it, the cell stays unknown here; otherwise the cell starts from the map's state, 5 or 1, and
//! takes several observations to contradict it. If there are too few of them in ten seconds, the
//! cell is reset to the map's state. A cell movable in the map starts at 4, so that one crossing
//! makes it free.
//!
//! A hit is near if it is within [`MappingConfig::near`](super::MappingConfig) of the sensor;
//! `local_map` decides which hits are near.

use ubimap_protocol::tile::{Row, TILE_SIDE, Tile};

/// The evidence of one tile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Evidence {
    /// Three words per row, one per plane, lowest bit first.
    rows: [[u32; 3]; TILE_SIDE],
}

/// A scan's observations in one row of a tile; a cell is in at most one of `free` and `hit`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RowSighting {
    /// Cells crossed by beams.
    pub free: u32,
    /// Cells in which beams ended.
    pub hit: u32,
}

impl RowSighting {
    /// No observation.
    pub const NONE: Self = Self { free: 0, hit: 0 };

    /// The observed cells.
    pub fn known(self) -> u32 {
        self.free | self.hit
    }
}

/// Two rows of a tile, combined: for each state, the columns in which at least one of the two cells
/// is in that state.
#[derive(Clone, Copy, Debug)]
pub(super) struct Certain {
    /// Columns with a certainly occupied cell (counter at 7), one bit each.
    pub(super) occupied: u32,
    /// Columns with a certainly free cell (counter at 1), one bit each.
    pub(super) free: u32,
    /// Columns with a known cell in neither of these states, one bit each.
    pub(super) neither: u32,
}

impl Evidence {
    /// All cells unknown.
    pub const NONE: Self = Self { rows: [[0; 3]; TILE_SIDE] };

    /// Adds a scan's observations of the rows from `first` on. Returns whether any hit raised the
    /// counter of its cell.
    pub fn add(&mut self, first: usize, sightings: impl Iterator<Item = RowSighting>) -> bool {
        let (_, rows) = self.rows.split_at_mut(first % TILE_SIDE);
        let mut news = 0;
        for (sighting, row) in sightings.zip(rows) {
            if sighting.known() != 0 {
                news |= count(row, sighting);
            }
        }
        news != 0
    }

    /// Like [`Evidence::add`], for a tile that is also in the server's map (`known`): drops the
    /// observations that agree with it. A separate function, because each of the two loops needs
    /// all registers.
    #[inline(never)]
    pub fn add_beside(
        &mut self,
        first: usize,
        sightings: impl Iterator<Item = RowSighting>,
        known: &Tile,
    ) -> bool {
        let (_, rows) = self.rows.split_at_mut(first % TILE_SIDE);
        let mut news = 0;
        for ((y, row), mut sighting) in (first..).zip(rows).zip(sightings) {
            leave_known(row, &mut sighting, known.row(y));
            news |= count(row, sighting);
        }
        news != 0
    }

    /// Adds near hits in rows from `first` on. Near hits count twice: once here, and once with the
    /// whole scan, which must be added afterwards.
    pub fn add_near(
        &mut self,
        first: usize,
        hits: impl Iterator<Item = u32>,
        known: Option<&Tile>,
    ) {
        let (_, rows) = self.rows.split_at_mut(first % TILE_SIDE);
        for ((y, row), hit) in (first..).zip(rows).zip(hits) {
            if hit != 0 {
                let mut sighting = RowSighting { free: 0, hit };
                leave_known(row, &mut sighting, known.map_or(Row::default(), |tile| tile.row(y)));
                count(row, sighting);
            }
        }
    }

    /// Resets the evidence against free cells of the server's map (`known`) to the map's state,
    /// unless this robot has already published the cell (`told`). Hits minutes apart are noise at
    /// the edge of a surface, not a change.
    pub(crate) fn settle(&mut self, known: &Tile, told: &Tile) {
        let known = known.low.iter().zip(&known.high);
        let told = told.low.iter().zip(&told.high);
        for (([low, middle, high], known), told) in self.rows.iter_mut().zip(known).zip(told) {
            let free = (*low | *middle) & known.0 & !(*high | known.1 | told.0 | told.1);
            *low |= free;
            *middle &= !free;
        }
    }

    /// The cells with certain states, combined for each pair of rows, from south to north.
    pub(super) fn certain(&self) -> impl Iterator<Item = Certain> {
        let certain = |[low, middle, high]: [u32; 3]| {
            let (occupied, free) = (low & middle & high, low & !middle & !high);
            [occupied, free, (low | middle | high) & !occupied & !free]
        };
        self.rows.as_chunks::<2>().0.iter().map(move |&[south, north]| {
            let ([occupied, free, neither], north) = (certain(south), certain(north));
            Certain {
                occupied: occupied | north[0],
                free: free | north[1],
                neither: neither | north[2],
            }
        })
    }

    /// The state of a row of cells.
    pub fn row(&self, y: usize) -> Row {
        let [low, middle, high] = self.rows.get(y).copied().unwrap_or_default();
        Row { low: (low | middle) & !high, high }
    }

    /// The state of each cell: unknown, free or occupied.
    pub fn cells(&self) -> Tile {
        let mut tile = Tile::UNKNOWN;
        let planes = tile.low.iter_mut().zip(&mut tile.high);
        for ((out_low, out_high), [low, middle, high]) in planes.zip(&self.rows) {
            *out_low = (low | middle) & !high;
            *out_high = *high;
        }
        tile
    }
}

/// Counts the observations of a row. A hit counts an unknown cell to 5, and any other up by one to
/// at most 7; a crossing counts an unknown cell to 3, and any other down by one to at least 1.
/// Returns the hits in cells that were not at the maximum.
#[inline(always)]
fn count(row: &mut [u32; 3], sighting: RowSighting) -> u32 {
    let [low, middle, high] = *row;
    let RowSighting { free, hit } = sighting;
    if hit != 0 && (low | middle | high) & (free | hit) == 0 {
        // A shortcut for the case that none of the observed cells is known.
        *row = [low | hit | free, middle | free, high | hit];
        return hit;
    }
    // An underflow gives 7, which becomes 3 without its highest bit.
    let down = free & !(low & !(middle | high));
    let borrow = down & !low;
    let [low, middle, high] = [low ^ down, middle ^ borrow, high & !(borrow & !middle)];
    *row = [low, middle, high];
    if hit == 0 {
        return 0;
    }
    // A cell is in at most one of `free` and `hit`, so the crossings have not changed these.
    let both = low & middle;
    let up = hit & !(both & high);
    // An unknown cell that is hit counts to 1, and its high bit then makes that 5.
    let begun = hit & !(low | middle | high);
    *row = [low ^ up, middle ^ (up & low), high ^ (up & both | begun)];
    up
}

/// Drops the observations that agree with the server's map, and starts the contradicted cells from
/// the map's state.
fn leave_known(row: &mut [u32; 3], sighting: &mut RowSighting, known: Row) {
    let [low, middle, high] = row;
    let unknown = !(*low | *middle | *high);
    let (known_free, known_occupied) = (unknown & known.low & !known.high, unknown & known.high);
    sighting.free &= !(sighting.hit | known_free);
    sighting.hit &= !known_occupied;
    *low |= sighting.hit & known_free | sighting.free & known_occupied & !known.low;
    *high |= sighting.free & known_occupied;
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use ubimap_protocol::tile::Cell;

    /// Reference implementation for one cell.
    fn plainly(value: u8, bit: usize, sighting: RowSighting, near: u32, known: Row) -> u8 {
        let is = |mask: u32| mask >> bit & 1 != 0;
        let up = |value: u8| if value == 0 { 5 } else { (value + 1).min(7) };
        let mut value = value;
        if value == 0 && (is(sighting.hit) || is(sighting.free)) {
            match (is(known.low), is(known.high)) {
                (_, true) if is(sighting.hit) => return 0,
                (low, true) => value = if low { 4 } else { 5 },
                (true, false) if !is(sighting.hit) => return 0,
                (true, false) => value = 1,
                (false, false) => {}
            }
        }
        if is(sighting.hit) {
            value = up(value);
            if is(near) {
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
                let sighting = RowSighting { free, hit };
                let mut tile = Tile::UNKNOWN;
                tile.set_row(y, known);
                evidence.add_near(y, [hit & near].into_iter(), Some(&tile));
                evidence.add_beside(y, [sighting].into_iter(), &tile);
                for (bit, value) in plain.iter_mut().enumerate() {
                    *value = plainly(*value, bit, sighting, near, known);
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
                let [low, middle, high] = evidence.rows[y].map(|word| (word >> x & 1) as u8);
                prop_assert_eq!(low | middle << 1 | high << 2, value);
            }
        }
    }
    #[test]
    fn unsent_cells_that_are_free_in_the_map_are_reset() {
        let cells = [Cell::Unknown, Cell::Free, Cell::Occupied, Cell::Movable];
        for (known_as, told_as) in cells.iter().flat_map(|known| cells.map(|told| (*known, told))) {
            // The cell at x has the value x.
            let mut evidence = Evidence::NONE;
            evidence.rows[5] = [0xAA, 0xCC, 0xF0];
            let (mut known, mut told) = (Tile::UNKNOWN, Tile::UNKNOWN);
            for x in 0..8 {
                known.set(x, 5, known_as);
                told.set(x, 5, told_as);
            }
            let before = evidence.clone();
            evidence.settle(&known, &told);
            if (known_as, told_as) == (Cell::Free, Cell::Unknown) {
                // The cells at 2 and 3 have been reset to 1.
                assert_eq!(evidence.rows[5], [0xAE, 0xC0, 0xF0]);
            } else {
                assert_eq!(evidence, before, "{known_as:?} {told_as:?}");
            }
        }
    }
}
