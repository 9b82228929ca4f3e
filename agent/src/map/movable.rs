//! What comes and goes: cells whose occupant is likely to move again (Aluckal: "extended
//! awareness").
//!
//! Changes are counted for blocks of 2 x 2 cells, in four states:
//!
//! | state | what has been seen of the block | goes on to | when |
//! |---|---|---|---|
//! | 0 | nothing that stood | 1 | a cell of it is occupied for certain |
//! | 1 | something stands | 2 | a cell of it is free for certain, and none is known to be otherwise |
//! | 2 | it has left | 3 | a cell of it is occupied for certain |
//! | 3 | something comes and goes | 1 | the tile is calm |
//!
//! The occupied cells of a block in state 3 are movable. A person who walks by once, or stands about
//! and leaves, brings a block to state 2; a door that opens and shuts, or whatever else returns, to
//! state 3. "For certain" is the end of the evidence counter's scale, so that a wall whose edge is
//! seen now in this cell and now in the next one stays a wall. A tile is calm when nothing has left it
//! or come back for ten minutes: what has left it is then forgotten (state 2 becomes 0).
//!
//! The evidence is looked at before it is published, not with each scan: what changes faster than it
//! is told makes no difference.

use ubimap_protocol::{
    tile::{TILE_SIDE, Tile},
    time::Instant,
};

use super::evidence::Evidence;
use crate::timing::CALM;

/// The western cell of each block in a word of two rows, where the low bit of its state is; the high
/// bit is beside it.
const BLOCKS: u32 = 0x5555_5555;

/// What has come and gone in a tile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Changes {
    /// The states of the blocks in two rows of cells.
    states: [u32; TILE_SIDE / 2],
    /// When something last left or came back, in [`ticks`].
    last: u32,
}

/// Units of 1.05 s.
fn ticks(moment: Instant) -> u32 {
    (moment.micros() >> 20) as u32
}

impl Changes {
    /// Nothing has been seen.
    pub(super) const NONE: Self = Self { states: [0; TILE_SIDE / 2], last: 0 };

    /// Looks at the evidence, at a moment of the robot's clock.
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

    /// Marks the occupied cells that are movable.
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

    /// One tile, looked at once a second.
    struct Watched {
        evidence: Evidence,
        changes: Changes,
        now: u64,
    }

    impl Watched {
        fn new() -> Self {
            Self { evidence: Evidence::NONE, changes: Changes::NONE, now: 5_000 }
        }

        /// Scans of two rows, and then a look. What is published of the cell at (4, 0).
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
    /// In the cell at (4, 0), and in one of another block.
    const STANDS: [RowSighting; 2] =
        [RowSighting { free: 0, hit: 0x10 }, RowSighting { free: 0x30, hit: 0x40 }];

    #[test]
    fn who_walks_by_once_is_not_movable_and_who_comes_back_is() {
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
    fn a_door_that_opens_and_shuts_is_movable_and_calms_down_if_it_stays_shut() {
        let mut watched = Watched::new();
        assert_eq!(watched.see(6, STANDS), Cell::Occupied);
        // Its edge is not seen for a while: it has not left.
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
        // And again.
        assert_eq!(watched.see(6, FREE), Cell::Free);
        assert_eq!(watched.see(6, STANDS), Cell::Movable);
    }

    /// The evidence of a cell, as a number.
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
        fn planes_change_like_states(
            steps in proptest::collection::vec(
                // Much of one kind in a row, or nothing would ever be certain.
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
