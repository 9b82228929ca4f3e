//! Detects cells whose occupant is likely to move again (Aluckal: "extended awareness").
//!
//! Changes are tracked for blocks of 2 x 2 cells, in four states:
//!
//! | state | history of the block | next | condition |
//! |---|---|---|---|
//! | 0 | never occupied | 1 | a cell of it is certainly occupied |
//! | 1 | occupied | 2 | a cell of it is certainly free, and so is every other known cell of it |
//! | 2 | vacated | 3 | a cell of it is certainly occupied |
//! | 3 | changes repeatedly | 1 | the tile is calm |
//!
//! The occupied cells of a block in state 3 are movable. A person who walks by once, or stays a
//! while and leaves, takes a block to state 2; a door that opens and closes, or anything else that
//! returns, to state 3. "Certainly" means the end of the evidence counter's scale, so that a wall
//! whose edge is seen alternately in two cells stays a wall. A tile is calm when no block of it was
//! vacated or reoccupied for ten minutes; vacated blocks are then forgotten (state 2 becomes 0).
//!
//! The evidence is evaluated before it is published, not with each scan: faster changes are not
//! sent anyway.

use ubimap_protocol::{
    tile::{TILE_SIDE, Tile},
    time::Instant,
};

use super::evidence::Evidence;
use crate::timing::CALM;

/// The low bits of the blocks' states in a word for two rows, each at the column of the block's
/// western cell; the high bit is next to it.
const BLOCKS: u32 = 0x5555_5555;

/// The history of changes in a tile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Changes {
    /// The states of the blocks, a word per two rows of cells.
    states: [u32; TILE_SIDE / 2],
    /// When a block was last vacated or reoccupied, in [`ticks`].
    last: u32,
}

/// Time in units of 1.05 s.
fn ticks(moment: Instant) -> u32 {
    (moment.micros() >> 20) as u32
}

impl Changes {
    /// Never occupied.
    pub(super) const NONE: Self = Self { states: [0; TILE_SIDE / 2], last: 0 };

    /// Updates the states of the blocks from the evidence at `now` (robot's clock).
    pub(super) fn look(&mut self, evidence: &Evidence, now: Instant) {
        let now = ticks(now);
        let is_calm = now.saturating_sub(self.last) >= ticks(Instant(CALM.0));
        for (states, certain) in self.states.iter_mut().zip(evidence.certain()) {
            if is_calm {
                *states &= BLOCKS;
            }
            let either = |cells: u32| (cells | cells >> 1) & BLOCKS;
            let (low, high) = (*states & BLOCKS, *states >> 1 & BLOCKS);
            let stands = either(certain.occupied);
            let left = either(certain.free) & !either(certain.neither) & !stands;
            let gone = left & low & !high;
            let back = stands & high & !low;
            let first = stands & !low & !high;
            *states = (low & !gone | first | back) | (high | gone) << 1;
            if gone | back != 0 {
                self.last = now;
            }
        }
    }

    /// Marks the occupied cells of blocks that change repeatedly as movable.
    pub(super) fn mark(&self, tile: &mut Tile) {
        let pairs = tile.low.as_chunks_mut::<2>().0.iter_mut().zip(tile.high.as_chunks::<2>().0);
        for (states, (low, high)) in self.states.iter().zip(pairs) {
            let movable = states & states >> 1 & BLOCKS;
            let movable = movable | movable << 1;
            low.iter_mut().zip(high).for_each(|(low, high)| *low |= high & movable);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::RowSighting;
    use proptest::prelude::*;
    use std::{iter, vec::Vec};
    use ubimap_protocol::tile::Cell;

    fn seconds(seconds: u64) -> Instant {
        Instant(seconds * 1_000_000)
    }

    /// One tile, evaluated once a second.
    struct Watched {
        evidence: Evidence,
        changes: Changes,
        now: u64,
    }

    impl Watched {
        fn new() -> Self {
            Self { evidence: Evidence::NONE, changes: Changes::NONE, now: 5_000 }
        }

        /// Adds `scans` scans of two rows, and evaluates the evidence. Returns the published state
        /// of the cell at (4, 0).
        fn see(&mut self, scans: usize, sightings: [RowSighting; 2]) -> Cell {
            for _ in 0..scans {
                self.evidence.add(0, sightings.into_iter());
            }
            self.now += 1;
            self.changes.look(&self.evidence, seconds(self.now));
            let mut tile = self.evidence.cells();
            self.changes.mark(&mut tile);
            tile.cell(4, 0)
        }
    }

    const FREE: [RowSighting; 2] = [RowSighting { free: 0xF0, hit: 0 }; 2];
    /// A hit in the cell at (4, 0), and one in another block.
    const STANDS: [RowSighting; 2] =
        [RowSighting { free: 0, hit: 0x10 }, RowSighting { free: 0x30, hit: 0x40 }];

    #[test]
    fn only_occupants_that_return_are_movable() {
        let mut watched = Watched::new();
        assert_eq!(watched.see(6, FREE), Cell::Free);
        for (visit, expected) in
            [Cell::Occupied, Cell::Movable, Cell::Movable].into_iter().enumerate()
        {
            assert_eq!(watched.see(6, STANDS), expected, "visit {visit}");
            assert_eq!(watched.see(6, FREE), Cell::Free);
        }
    }

    #[test]
    fn a_door_is_movable_until_it_has_stayed_closed() {
        let mut watched = Watched::new();
        assert_eq!(watched.see(6, STANDS), Cell::Occupied);
        // Beams miss the door's edge for a while: that does not vacate the block.
        assert_eq!(watched.see(3, FREE), Cell::Occupied);
        assert_eq!(watched.see(6, STANDS), Cell::Occupied);
        assert_eq!(watched.see(6, FREE), Cell::Free);
        for _ in 0..500 {
            assert_eq!(watched.see(6, STANDS), Cell::Movable);
        }
        watched.now += 98;
        assert_eq!(watched.see(6, STANDS), Cell::Movable);
        watched.now += 3;
        assert_eq!(watched.see(6, STANDS), Cell::Occupied);
        // The door opens again.
        assert_eq!(watched.see(6, FREE), Cell::Free);
        assert_eq!(watched.see(6, STANDS), Cell::Movable);
    }

    /// The evidence counter of a cell, as a number.
    fn count(value: u8, free: bool, hit: bool) -> u8 {
        match (value, hit, free) {
            (0, true, _) => 5,
            (0, false, true) => 3,
            (_, true, _) => (value + 1).min(7),
            (_, false, true) => (value - 1).max(1),
            _ => value,
        }
    }

    proptest! {
        /// The table of states, block by block.
        #[test]
        fn the_planes_follow_the_table_of_states(
            steps in proptest::collection::vec(
                // Long runs of the same observation, or nothing would ever be certain.
                (any::<[u32; 2]>(), 0..3u8, 1..7usize, 0..900u64), 0..40),
        ) {
            let mut watched = Watched::new();
            let mut cells = [[0u8; 32]; 2];
            let mut states = [0u8; 16];
            let mut last = 0;
            for (mask, kind, scans, wait) in steps {
                let sightings = mask.map(|mask| match kind {
                    0 => RowSighting { free: mask, hit: 0 },
                    1 => RowSighting { free: 0, hit: mask },
                    _ => RowSighting { free: mask, hit: !mask },
                });
                watched.now += wait / 300 * 300;
                watched.see(scans, sightings);
                for (row, sighting) in cells.iter_mut().zip(sightings) {
                    for (column, value) in row.iter_mut().enumerate() {
                        let is = |word: u32| word >> column & 1 != 0;
                        for _ in 0..scans {
                            *value = count(*value, is(sighting.free), is(sighting.hit));
                        }
                    }
                }
                let now = (watched.now * 1_000_000) >> 20;
                let is_calm = now - last >= 600_000_000 >> 20;
                for (index, state) in states.iter_mut().enumerate() {
                    let block: Vec<u8> = (0..4).map(|it| cells[it / 2][index * 2 + it % 2]).collect();
                    let stands = block.contains(&7);
                    let left = block.contains(&1) && block.iter().all(|&value| value <= 1);
                    if is_calm {
                        *state = [0, 1, 0, 1][usize::from(*state)];
                    }
                    *state = match *state {
                        0 if stands => 1,
                        1 if left => { last = now; 2 }
                        2 if stands => { last = now; 3 }
                        other => other,
                    };
                }
                let mut tile = watched.evidence.cells();
                watched.changes.mark(&mut tile);
                for (x, y) in (0..32).flat_map(|x| iter::repeat(x).zip(0..2)) {
                    let expected = match cells[y][x] {
                        0 => Cell::Unknown,
                        1..=3 => Cell::Free,
                        _ if states[x / 2] == 3 => Cell::Movable,
                        _ => Cell::Occupied,
                    };
                    prop_assert_eq!(tile.cell(x, y), expected, "{} {}", x, y);
                }
            }
        }
    }
}
