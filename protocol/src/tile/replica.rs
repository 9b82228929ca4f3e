//! A tile as its receiver holds it, and the sender's record of what the receiver holds.
//!
//! At most one update of a tile is in flight: the next one builds upon what has been acknowledged,
//! so updates never have to be reordered.

use core::fmt;

use super::{
    Epoch, Stamp, TILE_CELLS, TILE_SIDE, Tile, TileDecoder, TileEncoder, TileHeader, TileId,
    Version,
};

/// A tile at its receiver.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Replica {
    tile: Tile,
    stamp: Stamp,
    next: u16,
}

/// The effect of an update on a replica.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Applied {
    /// The tile has reached the state that the update announced.
    Complete,
    /// The tile is incomplete: further parts must follow.
    Partial,
    /// The update was stale and its cells were skipped.
    Old,
}

/// The replica does not hold the base of the update. The cells of the update, and everything after
/// it in the same message, cannot be read: request the whole tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BaseMissing;

impl fmt::Display for BaseMissing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the base of the tile update is not held: request the whole tile")
    }
}

impl core::error::Error for BaseMissing {}

impl Replica {
    /// A replica that has received nothing.
    pub const NOTHING: Self = Self { tile: Tile::UNKNOWN, stamp: Stamp::NOTHING, next: 0 };

    /// Restores a replica from storage: its cells, its stamp and its next cell (see
    /// [`Self::next`]).
    pub fn restored(tile: Tile, stamp: Stamp, next: u16) -> Self {
        Self { tile, stamp, next }
    }

    /// The cells. While parts are missing, some cells are newer than others.
    pub fn tile(&self) -> &Tile {
        &self.tile
    }

    /// The stamp of the newest state received, even in part; version zero if nothing has arrived.
    pub fn stamp(&self) -> Stamp {
        self.stamp
    }

    /// The first missing cell of the state that [`Self::stamp`] names, 1 to 1,023; 0 if that state
    /// is complete.
    pub fn next(&self) -> u16 {
        self.next
    }

    /// Whether the state that [`Self::stamp`] names is incomplete.
    pub fn is_partial(&self) -> bool {
        self.next != 0
    }

    /// Reads the cells described by `header` from `decoder`, and returns their effect.
    ///
    /// # Errors
    /// [`BaseMissing`]; the replica is unchanged.
    pub fn apply(
        &mut self,
        header: &TileHeader,
        decoder: &mut TileDecoder<'_>,
    ) -> Result<Applied, BaseMissing> {
        let held = header.stamp == self.stamp && !self.is_partial();
        match (header.start, header.base) {
            // There are two cases. A whole tile that its sender gave up may arrive after its
            // replacement: it is skipped. Or the sender does not know that this side holds the
            // state, and sends it again in parts: the first part was skipped, and later parts may
            // be newer than the cells held.
            (start, None) if held || start == 0 && header.stamp < self.stamp => {
                let mut part = self.tile;
                copy_cells(&Tile::UNKNOWN, &mut part, start, TILE_CELLS);
                decoder.cells(header, &mut part);
                if start == 0 {
                    let is_same = is_same_until(header.end, &part, &self.tile);
                    if !held || header.end == TILE_CELLS || is_same {
                        return Ok(Applied::Old);
                    }
                    // The tile held is from an earlier run of the sender with the same epoch: later
                    // parts can't be decoded against its cells.
                    (self.tile, self.next) = (part, header.end);
                    return Ok(Applied::Partial);
                }
                copy_cells(&part, &mut self.tile, start, header.end);
                return Ok(Applied::Complete);
            }
            (0, None) => self.tile = Tile::UNKNOWN,
            (0, Some(base)) => {
                let base = Stamp { version: base, ..header.stamp };
                if self.stamp != base || self.is_partial() {
                    return Err(BaseMissing);
                }
            }
            (start, _) => {
                if self.stamp != header.stamp || self.next != start {
                    return Err(BaseMissing);
                }
            }
        }
        decoder.cells(header, &mut self.tile);
        self.stamp = header.stamp;
        self.next = if header.end < TILE_CELLS { header.end } else { 0 };
        Ok(if self.is_partial() { Applied::Partial } else { Applied::Complete })
    }
}

/// A tile at its sender: the record of what one receiver holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Publication {
    /// The cells as sent, acknowledged or not.
    sent: Tile,
    /// The version that is being sent or was sent last.
    version: Version,
    /// The version that the receiver has acknowledged.
    base: Option<Version>,
    /// The next cell of `version` to send; 0 if all of it has been sent.
    next: u16,
    /// The frame that carried the last update.
    frame: u16,
    under_way: bool,
}

impl Default for Publication {
    fn default() -> Self {
        Self::NOTHING
    }
}

impl Publication {
    /// The record of a tile that has never been sent.
    pub const NOTHING: Self = Self {
        sent: Tile::UNKNOWN,
        version: Version(0),
        base: None,
        next: 0,
        frame: 0,
        under_way: false,
    };

    /// The version that is being sent or was sent last; zero if none was.
    pub fn version(&self) -> Version {
        self.version
    }

    /// The cells as sent, acknowledged or not. While a whole tile is sent again in parts, the cells
    /// after the last part are those of the previous transmission.
    pub fn sent(&self) -> &Tile {
        &self.sent
    }

    /// Whether something was sent and the receiver has acknowledged all of it.
    pub fn is_acknowledged(&self) -> bool {
        !self.under_way && self.next == 0 && self.base == Some(self.version)
    }

    /// Whether an update may be sent now: none is in flight.
    pub fn is_ready(&self) -> bool {
        !self.under_way
    }

    /// Whether the last update was a part and more parts follow.
    pub fn has_parts_left(&self) -> bool {
        self.next != 0
    }

    /// Whether there is something to send: cells of `new` that the receiver does not hold, or
    /// missing parts of an update.
    pub fn differs(&self, new: &Tile) -> bool {
        self.base.is_none() || self.next != 0 || self.sent != *new
    }

    /// Adds the changes up to `new` to an update that will travel in frame `frame`. `version` is
    /// the writer's version of the tile, greater than any sent before; missing parts of an earlier
    /// version are sent first. Returns false if no cell fitted.
    ///
    /// Overwrites the cells of `new` that earlier parts have already sent with what they sent.
    pub fn push(
        &mut self,
        encoder: &mut TileEncoder<'_>,
        id: TileId,
        epoch: Epoch,
        version: Version,
        new: &mut Tile,
        frame: u16,
    ) -> bool {
        let start = self.next;
        let mut old = self.sent;
        if self.base.is_none() {
            // Without a base the receiver starts from unknown cells as well.
            copy_cells(&Tile::UNKNOWN, &mut old, start, TILE_CELLS);
        }
        copy_cells(&old, new, 0, start);
        let version = if start == 0 { version } else { self.version };
        let stamp = Stamp { epoch, version };
        let Some(end) = encoder.push(id, stamp, self.base, start, &old, new) else {
            return false;
        };
        copy_cells(new, &mut self.sent, start, end);
        self.version = version;
        self.next = end % TILE_CELLS;
        self.frame = frame;
        self.under_way = true;
        true
    }

    /// Processes the acknowledgement of a frame. Returns whether it carried this tile.
    pub fn acknowledge(&mut self, frame: u16) -> bool {
        let mine = self.under_way && self.frame == frame;
        if mine {
            self.under_way = false;
            if self.next == 0 {
                self.base = Some(self.version);
            }
        }
        mine
    }

    /// Whether the last updates of this tile and of `other` were in the same frame: a receiver that
    /// could not read one of them may not have read the other.
    pub fn travelled_with(&self, other: &Self) -> bool {
        self.version != Version(0) && self.frame == other.frame
    }

    /// Forgets what the receiver holds: the tile will be sent whole.
    pub fn forget(&mut self) {
        self.base = None;
        self.next = 0;
        self.under_way = false;
    }

    /// Ends the session. If an update is in flight or incomplete, it is lost, and the tile will be
    /// sent whole.
    pub fn interrupt(&mut self) {
        if self.under_way || self.next != 0 {
            self.forget();
        }
    }
}

/// The cells of row `y` with numbers below `cell`, a bit each.
fn below(cell: u16, y: usize) -> u32 {
    ((1u64 << usize::from(cell).saturating_sub(y * TILE_SIDE).min(TILE_SIDE)) - 1) as u32
}

/// Whether two tiles have the same cells with numbers below `end`.
fn is_same_until(end: u16, one: &Tile, other: &Tile) -> bool {
    (0..TILE_SIDE).all(|y| {
        let (one, other) = (one.row(y), other.row(y));
        (one.low ^ other.low | one.high ^ other.high) & below(end, y) == 0
    })
}

/// Copies the cells with numbers `from..to`.
fn copy_cells(source: &Tile, target: &mut Tile, from: u16, to: u16) {
    for y in usize::from(from) / TILE_SIDE..usize::from(to).div_ceil(TILE_SIDE) {
        let mask = below(to, y) & !below(from, y);
        let (mut row, new) = (target.row(y), source.row(y));
        row.low = row.low & !mask | new.low & mask;
        row.high = row.high & !mask | new.high & mask;
        target.set_row(y, row);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tile::Cell;
    use proptest::prelude::*;

    fn noise(seed: u32) -> Tile {
        let mut tile = Tile::UNKNOWN;
        for y in 0..TILE_SIDE as u32 {
            let word = (seed + y).wrapping_mul(0x9E37_79B9) ^ seed << 7;
            tile.low[y as usize] = word;
            tile.high[y as usize] = word.rotate_left(11) & word;
        }
        tile
    }

    const ID: TileId = TileId { x: 3, y: -4 };
    const EPOCH: Epoch = Epoch(2);

    proptest! {
        /// Both sides hold the same tile in the end, whichever frames are lost with their sessions.
        #[test]
        fn a_replica_catches_up(losses in proptest::collection::vec(any::<bool>(), 1..40), room in 20usize..200) {
            let mut publication = Publication::NOTHING;
            let mut replica = Replica::default();
            let mut version = 0;
            let mut frame = 0;
            for lost in losses.iter().copied().chain([false; 80]) {
                let changing = (frame as usize) < losses.len();
                let current = noise(if changing { u32::from(frame) } else { 999 });
                frame += 1;
                if !publication.differs(&current) {
                    continue;
                }
                version += 1;
                let mut out = [0u8; 200];
                let mut encoder = TileEncoder::new(&mut out[..room]);
                let mut new = current;
                prop_assert!(publication.push(&mut encoder, ID, EPOCH, Version(version), &mut new, frame));
                let len = encoder.finish().unwrap();
                if lost {
                    publication.interrupt();
                    continue;
                }
                let mut decoder = TileDecoder::new(&out[..len]);
                let header = decoder.header().unwrap().unwrap();
                match replica.apply(&header, &mut decoder) {
                    Ok(_) => prop_assert!(publication.acknowledge(frame)),
                    Err(BaseMissing) => publication.forget(),
                }
            }
            prop_assert_eq!(replica.tile(), &noise(999));
            prop_assert_eq!(replica.stamp(), Stamp { epoch: EPOCH, version: publication.version() });
            prop_assert!(publication.is_acknowledged());
        }
    }

    #[test]
    fn a_restored_replica_continues_where_it_was_saved() {
        let mut publication = Publication::NOTHING;
        let mut replica = Replica::default();
        for frame in 1.. {
            let mut out = [0u8; 80];
            let mut encoder = TileEncoder::new(&mut out);
            let mut new = noise(1);
            assert!(publication.is_ready());
            assert!(publication.push(&mut encoder, ID, EPOCH, Version(3), &mut new, frame));
            assert!(!publication.is_ready(), "the update is in flight");
            let len = encoder.finish().unwrap();
            let mut decoder = TileDecoder::new(&out[..len]);
            let header = decoder.header().unwrap().unwrap();
            replica = Replica::restored(*replica.tile(), replica.stamp(), replica.next());
            replica.apply(&header, &mut decoder).unwrap();
            assert_eq!(replica.next(), header.end % TILE_CELLS);
            assert!(publication.acknowledge(frame));
            if !publication.has_parts_left() {
                break;
            }
        }
        let stamp = Stamp { epoch: EPOCH, version: Version(3) };
        assert_eq!(replica, Replica::restored(noise(1), stamp, 0));
    }

    fn push(publication: &mut Publication, tile: &Tile, room: usize, frame: u16) {
        let mut out = std::vec![0u8; room];
        let version = Version(publication.version().0 + 1);
        let mut new = *tile;
        let mut encoder = TileEncoder::new(&mut out);
        assert!(publication.push(&mut encoder, ID, EPOCH, version, &mut new, frame));
    }

    #[test]
    fn a_publication_records_what_the_receiver_holds() {
        let (old, new) = (noise(1), noise(2));
        let mut publication = Publication::NOTHING;
        assert!(publication.differs(&Tile::UNKNOWN), "the receiver may hold anything");
        push(&mut publication, &old, 600, 1);
        assert!(!publication.acknowledge(2) && !publication.is_ready(), "another frame");
        assert!(publication.acknowledge(1) && publication.is_ready());
        assert!(!publication.acknowledge(1), "acknowledged already");
        assert!(!publication.differs(&old) && publication.differs(&new));

        let held = publication.clone();
        publication.interrupt();
        assert_eq!(publication, held, "what was acknowledged stays with the receiver");
        push(&mut publication, &new, 600, 2);
        publication.interrupt();
        assert!(publication.is_ready() && publication.differs(&new), "lost in flight");

        let mut publication = held;
        push(&mut publication, &new, 60, 2);
        assert!(publication.acknowledge(2) && publication.has_parts_left());
        let sent = *publication.sent();
        assert!(publication.differs(&sent), "parts are missing");
        publication.interrupt();
        assert!(!publication.has_parts_left() && publication.differs(&sent));
    }

    #[test]
    fn tiles_travel_together_in_one_frame() {
        let mut publications = [const { Publication::NOTHING }; 4];
        let [first, second, later, never] = &mut publications;
        push(first, &noise(1), 600, 0);
        push(second, &noise(2), 600, 0);
        push(later, &noise(3), 600, 1);
        assert!(first.travelled_with(second) && second.travelled_with(first));
        assert!(!first.travelled_with(later) && !later.travelled_with(first));
        assert!(!never.travelled_with(first) && !never.travelled_with(later), "never sent");
    }

    #[test]
    fn a_stale_whole_tile_takes_nothing_back() {
        let whole = |version: u32, room: usize| {
            let mut out = std::vec![0; room];
            let mut encoder = TileEncoder::new(&mut out);
            let stamp = Stamp { epoch: EPOCH, version: Version(version) };
            let end = encoder.push(ID, stamp, None, 0, &Tile::UNKNOWN, &noise(version)).unwrap();
            let len = encoder.finish().unwrap();
            out.truncate(len);
            (out, end)
        };
        let apply = |replica: &mut Replica, coded: &[u8]| {
            let mut decoder = TileDecoder::new(coded);
            let header = decoder.header().unwrap().unwrap();
            let applied = replica.apply(&header, &mut decoder).unwrap();
            // The rest of the update is still readable.
            assert_eq!(decoder.header(), Ok(None));
            applied
        };
        let (part, end) = whole(5, 60);
        assert!(end < TILE_CELLS);
        let mut replica = Replica::default();
        assert_eq!(apply(&mut replica, &whole(4, 600).0), Applied::Complete);
        assert_eq!(apply(&mut replica, &part), Applied::Partial);
        assert_eq!(apply(&mut replica, &whole(4, 600).0), Applied::Old);
        assert!(replica.is_partial());
        assert_eq!(apply(&mut replica, &whole(5, 600).0), Applied::Complete);
        for late in [&part, &whole(5, 600).0, &whole(4, 600).0, &whole(3, 60).0] {
            assert_eq!(apply(&mut replica, late), Applied::Old);
            assert_eq!((replica.tile(), replica.stamp().version), (&noise(5), Version(5)));
            assert!(!replica.is_partial());
        }
    }

    /// A sender leaves out cells that others publish unless it has sent them itself, so it must
    /// remember which cells it has sent.
    #[test]
    fn sent_cells_are_remembered_while_the_tile_is_sent_whole_again() {
        let mut publication = Publication::NOTHING;
        let mut send = |room: usize, frame: u16| {
            let mut out = std::vec![0u8; room];
            let mut encoder = TileEncoder::new(&mut out);
            let pushed =
                publication.push(&mut encoder, ID, EPOCH, Version(5), &mut noise(1), frame);
            assert_eq!(publication.acknowledge(frame), pushed);
            let left = publication.has_parts_left();
            assert_eq!(*publication.sent(), noise(1));
            publication.forget();
            (pushed, left)
        };
        assert_eq!(send(600, 1), (true, false));
        assert_eq!(send(4, 2), (false, false));
        assert_eq!(send(60, 3), (true, true));
    }

    #[test]
    fn a_tile_that_is_held_already_can_come_in_parts() {
        let mut replica = Replica::default();
        let mut send = |publication: &mut Publication, tile: &Tile, frame: u16| {
            let mut out = [0u8; 80];
            let mut encoder = TileEncoder::new(&mut out);
            let mut new = *tile;
            assert!(publication.push(&mut encoder, ID, EPOCH, Version(5), &mut new, frame));
            let len = encoder.finish().unwrap();
            let mut decoder = TileDecoder::new(&out[..len]);
            let header = decoder.header().unwrap().unwrap();
            replica.apply(&header, &mut decoder).unwrap();
            assert!(publication.acknowledge(frame));
            *replica.tile()
        };
        // A new session begins; meanwhile the tile changes, and later parts hold its new state.
        let mut frames = 0;
        for tiles in [[noise(1), noise(1)], [noise(1), noise(1)], [noise(1), noise(2)]] {
            let mut publication = Publication::NOTHING;
            let [mut tile, then] = tiles;
            while !publication.is_acknowledged() {
                frames += 1;
                let held = send(&mut publication, &tile, frames);
                tile = then;
                assert!(!publication.is_acknowledged() || held == *publication.sent());
            }
        }
        assert!(frames > 6);
    }

    #[test]
    fn another_state_with_the_same_stamp_replaces_the_one_held_if_it_comes_in_parts() {
        let mut replica =
            Replica::restored(noise(1), Stamp { epoch: EPOCH, version: Version(5) }, 0);
        let mut publication = Publication::NOTHING;
        for frame in 1.. {
            let mut out = [0u8; 80];
            let mut encoder = TileEncoder::new(&mut out);
            let mut new = noise(2);
            assert!(publication.push(&mut encoder, ID, EPOCH, Version(5), &mut new, frame));
            let len = encoder.finish().unwrap();
            let mut decoder = TileDecoder::new(&out[..len]);
            let header = decoder.header().unwrap().unwrap();
            replica.apply(&header, &mut decoder).unwrap();
            assert_eq!(decoder.header(), Ok(None));
            assert!(publication.acknowledge(frame));
            if publication.is_acknowledged() {
                break;
            }
        }
        assert_eq!((replica.tile(), replica.is_partial()), (&noise(2), false));
    }

    #[test]
    fn an_update_to_a_base_that_is_not_held_changes_nothing() {
        let mut tile = Tile::UNKNOWN;
        tile.set(1, 1, Cell::Free);
        let mut out = [0u8; 100];
        let mut encoder = TileEncoder::new(&mut out);
        let stamp = Stamp { epoch: EPOCH, version: Version(5) };
        encoder.push(ID, stamp, Some(Version(4)), 0, &Tile::UNKNOWN, &tile).unwrap();
        let len = encoder.finish().unwrap();
        let mut decoder = TileDecoder::new(&out[..len]);
        let header = decoder.header().unwrap().unwrap();
        let mut replica = Replica::default();
        assert_eq!(replica.apply(&header, &mut decoder), Err(BaseMissing));
        assert_eq!(replica, Replica::default());
    }
}
