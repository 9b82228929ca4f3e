//! What the peer has published: its tiles as a receiver holds them, and every update.

use std::{collections::BTreeMap, rc::Rc};

use ubimap_protocol::{
    message::TileUpdateHead,
    tile::{
        Applied, Epoch, Layer, Replica, Stamp, TILE_CELLS, TileDecoder, TileHeader, TileId,
        tile_hash,
    },
    time::Instant,
};

use super::frames::Frame;

/// A frame of the peer.
#[derive(Clone, Debug)]
pub(super) struct Carrier {
    pub(super) at: Instant,
    pub(super) wire: Vec<u8>,
    pub(super) frame: Frame,
}

/// A tile in an update.
#[derive(Clone, Debug)]
pub(super) struct Update {
    /// The frame that it came in.
    pub(super) carrier: Rc<Carrier>,
    pub(super) layer: Layer,
    pub(super) header: TileHeader,
    /// The stamp that was held before.
    pub(super) held: Stamp,
    /// `None` if its base is not held.
    pub(super) applied: Option<Applied>,
}

impl Update {
    /// Whether it begins a tile without a base.
    pub(super) fn is_whole(&self) -> bool {
        self.header.base.is_none() && self.header.start == 0
    }

    pub(super) fn is_last_part(&self) -> bool {
        self.header.end == TILE_CELLS
    }
}

/// What the peer has published.
#[derive(Debug, Default)]
pub(super) struct Followed {
    pub(super) tiles: BTreeMap<(u8, TileId, Epoch), Replica>,
    /// The hash of each complete state.
    hashes: BTreeMap<(u8, TileId, Stamp), u32>,
    pub(super) updates: Vec<Update>,
    /// Updates that can't be read, each with the reason and its frame.
    pub(super) unread: Vec<(String, Rc<Carrier>)>,
}

impl Followed {
    /// Applies an update.
    pub(super) fn take(&mut self, (head, coded): (TileUpdateHead, &[u8]), carrier: &Rc<Carrier>) {
        let TileUpdateHead { layer, .. } = head;
        let mut decoder = TileDecoder::new(coded);
        loop {
            let header = match decoder.header() {
                Ok(Some(header)) => header,
                Ok(None) => return,
                Err(error) => {
                    return self.unread.push((error.to_string(), Rc::clone(carrier)));
                }
            };
            let held = self.tiles.entry((layer as u8, header.id, header.stamp.epoch)).or_default();
            let before = held.stamp();
            let applied = held.apply(&header, &mut decoder).ok();
            if applied == Some(Applied::Complete) {
                let hash = tile_hash(held.tile());
                self.hashes.insert((layer as u8, header.id, header.stamp), hash);
            }
            let carrier = Rc::clone(carrier);
            self.updates.push(Update { carrier, layer, header, held: before, applied });
            if applied.is_none() {
                return;
            }
        }
    }

    /// The newest state held of a tile.
    pub(super) fn held(&self, layer: Layer, id: TileId, epoch: Epoch) -> Option<&Replica> {
        self.tiles.get(&(layer as u8, id, epoch))
    }

    /// The hash of a state that was complete.
    pub(super) fn hash(&self, layer: Layer, id: TileId, stamp: Stamp) -> Option<u32> {
        self.hashes.get(&(layer as u8, id, stamp)).copied()
    }

    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}
