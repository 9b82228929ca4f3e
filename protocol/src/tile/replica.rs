//! A tile as its receiver holds it, and as its sender knows that the receiver holds it.
//!
//! At most one update of a tile is under way at a time: the next one builds upon what has been
//! acknowledged, so no update ever waits for another one to arrive first.

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

/// What an update did to a replica.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Applied {
    /// The tile is now in the state that the update announced.
    Complete,
    /// Further parts must follow.
    Partial,
    /// It came late: what the tile holds is as new, or newer. It was read past.
    Old,
}

/// The replica does not hold what the update builds upon. The cells of the update, and whatever
/// follows it in the same message, cannot be read: ask for the whole tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BaseMissing;

impl Replica {
    /// Nothing has arrived yet.
    pub const NOTHING: Self = Self { tile: Tile::UNKNOWN, stamp: Stamp::NOTHING, next: 0 };

    /// A replica that was kept elsewhere: its cells, its stamp and its next cell.
    pub fn restored(tile: Tile, stamp: Stamp, next: u16) -> Self {
        Self { tile, stamp, next }
    }

    /// The cells. While parts are missing, some of them are newer than the others.
    pub fn tile(&self) -> &Tile {
        &self.tile
    }

    /// The newest state of which something has arrived; version zero if there is none.
    pub fn stamp(&self) -> Stamp {
        self.stamp
    }

    /// The next cell of that state, 0 to 1,023; 0 if all of it has arrived.
    pub fn next(&self) -> u16 {
        self.next
    }

    /// Whether that state has arrived in part only.
    pub fn is_partial(&self) -> bool {
        self.next != 0
    }

    /// Reads the cells that `header` has announced from `decoder`.
    ///
    /// # Errors
    /// [`BaseMissing`]; the replica is as it was.
    pub fn apply(
        &mut self,
        header: &TileHeader,
        decoder: &mut TileDecoder<'_>,
    ) -> Result<Applied, BaseMissing> {
        let held = header.stamp == self.stamp && !self.is_partial();
        match (header.start, header.base) {
            // Either one that was given up by its sender and comes after the one that was sent in
            // its stead, or a part of one that is held: its sender does not know that, and what
            // came before was read past. Parts after the first may be newer than that.
            (start, None) if held || start == 0 && header.stamp < self.stamp => {
                let mut part = self.tile;
                copy_cells(&Tile::UNKNOWN, &mut part, start, TILE_CELLS);
                decoder.cells(header, &mut part);
                if start == 0 {
                    return Ok(Applied::Old);
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

/// A tile at its sender: what one receiver holds of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Publication {
    /// The cells as sent, acknowledged or not.
    sent: Tile,
    /// The version that is, or was last, sent.
    version: Version,
    /// The version that the receiver is known to hold.
    base: Option<Version>,
    /// The next cell of `version` to send; 0 if it has all been sent.
    next: u16,
    /// The frame that the last update travelled in.
    frame: u16,
    under_way: bool,
}

impl Default for Publication {
    fn default() -> Self {
        Self::NOTHING
    }
}

impl Publication {
    /// Nothing has been sent yet.
    pub const NOTHING: Self = Self {
        sent: Tile::UNKNOWN,
        version: Version(0),
        base: None,
        next: 0,
        frame: 0,
        under_way: false,
    };

    /// The version that is, or was last, sent; zero if none was.
    pub fn version(&self) -> Version {
        self.version
    }

    /// The cells as sent; of a whole tile that is sent again in parts, those that were sent before
    /// where the new ones have not been yet.
    pub fn sent(&self) -> &Tile {
        &self.sent
    }

    /// Whether the receiver holds all that was sent, and it was something.
    pub fn is_acknowledged(&self) -> bool {
        !self.under_way && self.next == 0 && self.base == Some(self.version)
    }

    /// Whether an update could be sent now: none is under way.
    pub fn is_ready(&self) -> bool {
        !self.under_way
    }

    /// Whether the last update was a part, with more to come.
    pub fn has_parts_left(&self) -> bool {
        self.next != 0
    }

    /// Whether there is more to send: cells of `new` that the receiver does not hold, or the rest
    /// of an update.
    pub fn differs(&self, new: &Tile) -> bool {
        self.base.is_none() || self.next != 0 || self.sent != *new
    }

    /// Adds the difference to `new` to an update that will travel in frame `frame`. `version` is
    /// that of the tile's writer, greater than any sent before; parts of an earlier one that are
    /// missing come first. `false` if not even one cell fitted.
    ///
    /// `new` is changed where it must not differ from what has been sent already.
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
            // A whole tile: the receiver starts from nothing as well.
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

    /// A frame has been acknowledged. Whether this tile travelled in it.
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

    /// Whether the last update travelled in the same frame as that of `other`: if the receiver
    /// could not read the one, it may not have read the other.
    pub fn travelled_with(&self, other: &Self) -> bool {
        self.version != Version(0) && self.frame == other.frame
    }

    /// It is not known what the receiver holds: the tile will be sent whole.
    pub fn forget(&mut self) {
        self.base = None;
        self.next = 0;
        self.under_way = false;
    }

    /// The session ended: what was under way is lost, what was acknowledged is not.
    pub fn interrupt(&mut self) {
        if self.under_way || self.next != 0 {
            self.forget();
        }
    }
}

/// Copies the cells `from..to`, counted row by row.
fn copy_cells(source: &Tile, target: &mut Tile, from: u16, to: u16) {
    let (from, to) = (usize::from(from), usize::from(to));
    for y in from / TILE_SIDE..to.div_ceil(TILE_SIDE) {
        let below =
            |cell: usize| ((1u64 << cell.saturating_sub(y * TILE_SIDE).min(TILE_SIDE)) - 1) as u32;
        let mask = below(to) & !below(from);
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
        /// Whatever frames are lost with their session, the two sides end up level.
        #[test]
        fn a_replica_ends_level(losses in proptest::collection::vec(any::<bool>(), 1..40), room in 20usize..200) {
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
    fn a_whole_tile_that_comes_late_takes_nothing_back() {
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
            // What follows in the same update can still be read.
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

    /// The sender leaves out what others say as well, unless it has told it: it must not forget
    /// that it has.
    #[test]
    fn what_was_sent_is_known_while_the_tile_is_sent_whole_again() {
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
        // A session begins anew; meanwhile the tile changes, and the rest of it is of its new state.
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
