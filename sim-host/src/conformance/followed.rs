//! What the peer has published: its tiles as a receiver holds them, and every update.

use std::collections::BTreeMap;

use ubimap_protocol::{
    message::TileUpdateHead,
    tile::{Applied, Epoch, Layer, Replica, Stamp, TILE_CELLS, TileDecoder, TileHeader, TileId},
};

/// A tile in an update.
#[derive(Clone, Debug)]
pub(super) struct Update {
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
    pub(super) updates: Vec<Update>,
    /// Updates that can't be read, each with the reason.
    pub(super) unread: Vec<String>,
}

impl Followed {
    /// Applies an update.
    pub(super) fn take(&mut self, (head, coded): (TileUpdateHead, &[u8])) {
        let TileUpdateHead { layer, .. } = head;
        let mut decoder = TileDecoder::new(coded);
        loop {
            let header = match decoder.header() {
                Ok(Some(header)) => header,
                Ok(None) => return,
                Err(error) => return self.unread.push(error.to_string()),
            };
            let held = self.tiles.entry((layer as u8, header.id, header.stamp.epoch)).or_default();
            let before = held.stamp();
            let applied = held.apply(&header, &mut decoder).ok();
            self.updates.push(Update { layer, header, held: before, applied });
            if applied.is_none() {
                return;
            }
        }
    }

    /// The newest state held of a tile.
    pub(super) fn held(&self, layer: Layer, id: TileId, epoch: Epoch) -> Option<&Replica> {
        self.tiles.get(&(layer as u8, id, epoch))
    }

    pub(super) fn clear(&mut self) {
        *self = Self::default();
    }
}
