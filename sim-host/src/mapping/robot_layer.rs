//! What one robot has seen, as the server holds it: the epochs of each tile, joined.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::tile::{
    Applied, BaseMissing, Epoch, Replica, Stamp, Tile, TileDecoder, TileError, TileId,
};

/// One epoch of one tile.
#[derive(Clone, Debug, Default)]
struct Held {
    replica: Replica,
    /// What the replica held before it was begun anew within its epoch: what is known stays
    /// known until the new whole has arrived.
    before: Option<Tile>,
}

/// The layer of one robot. For each cell the code is that of the newest epoch that knows it, so
/// the layer does not depend on the order in which states of its tiles arrive.
#[derive(Clone, Debug, Default)]
pub struct RobotLayer {
    tiles: BTreeMap<TileId, BTreeMap<Epoch, Held>>,
    newest_scan: BTreeMap<TileId, u32>,
}

/// What an update came to.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Updated {
    /// The tiles that have changed.
    pub tiles: BTreeSet<TileId>,
    /// The tile that could not be read because its base is not held. What followed it in the
    /// update was lost as well; asking for this tile brings all of that back.
    pub missing: Option<TileId>,
}

impl RobotLayer {
    /// Takes the coded tiles of an update whose newest scan was taken at `seconds`.
    ///
    /// # Errors
    /// What follows a [`TileError`] is not read; the second value is what came before it.
    pub fn update(&mut self, coded: &[u8], seconds: u32) -> (Updated, Result<(), TileError>) {
        let mut updated = Updated::default();
        let mut decoder = TileDecoder::new(coded);
        loop {
            let header = match decoder.header() {
                Ok(Some(header)) => header,
                Ok(None) => return (updated, Ok(())),
                Err(error) => return (updated, Err(error)),
            };
            let epochs = self.tiles.entry(header.id).or_default();
            let held = epochs.entry(header.stamp.epoch).or_default();
            if header.base.is_none() && header.start == 0 {
                let mut before = *held.replica.tile();
                if let Some(earlier) = &held.before {
                    before.fill_unknown_from(earlier);
                }
                held.before = Some(before);
            }
            match held.replica.apply(&header, &mut decoder) {
                Ok(Applied::Complete) => held.before = None,
                Ok(Applied::Partial) => {}
                Err(BaseMissing) => {
                    epochs.retain(|_, held| *held.replica.tile() != Tile::UNKNOWN);
                    updated.missing = Some(header.id);
                    return (updated, Ok(()));
                }
            }
            let newest = self.newest_scan.entry(header.id).or_default();
            *newest = seconds.max(*newest);
            updated.tiles.insert(header.id);
        }
    }

    /// What the robot has seen of a tile.
    pub fn tile(&self, id: TileId) -> Tile {
        let mut joined = Tile::UNKNOWN;
        for held in self.tiles.get(&id).into_iter().flat_map(|epochs| epochs.values().rev()) {
            joined.fill_unknown_from(held.replica.tile());
            if let Some(before) = &held.before {
                joined.fill_unknown_from(before);
            }
        }
        joined
    }

    /// The tiles of which the robot has seen something.
    pub fn ids(&self) -> impl Iterator<Item = TileId> + '_ {
        self.tiles.keys().copied()
    }

    /// When the newest scan in a tile was taken, in seconds of the server's clock.
    pub fn newest_scan(&self, id: TileId) -> Option<u32> {
        self.newest_scan.get(&id).copied()
    }

    /// The newest complete state of an epoch of a tile, and its cells.
    pub fn held(&self, id: TileId, epoch: Epoch) -> Option<(Stamp, &Tile)> {
        let held = self.tiles.get(&id)?.get(&epoch)?;
        let complete = held.before.is_none() && !held.replica.is_partial();
        complete.then(|| (held.replica.stamp(), held.replica.tile()))
    }

    /// The first epoch that the robot has not used.
    pub fn next_epoch(&self) -> Epoch {
        let used = self.tiles.values().filter_map(|epochs| epochs.keys().next_back()).max();
        used.map_or(Epoch(1), |epoch| Epoch(epoch.0.wrapping_add(1)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::tile::{Cell, TileEncoder, Version};

    const ID: TileId = TileId { x: 1, y: 2 };

    fn update(epoch: u32, version: u32, base: Option<(u32, &Tile)>, new: &Tile) -> Vec<u8> {
        let mut out = [0u8; 1024];
        let mut encoder = TileEncoder::new(&mut out);
        let stamp = Stamp { epoch: Epoch(epoch), version: Version(version) };
        let old = base.map_or(&Tile::UNKNOWN, |(_, old)| old);
        let base = base.map(|(base, _)| Version(base));
        encoder.push(ID, stamp, base, 0, old, new).unwrap();
        let len = encoder.finish().unwrap();
        out[..len].to_vec()
    }

    fn tile(cells: &[(usize, Cell)]) -> Tile {
        let mut tile = Tile::UNKNOWN;
        cells.iter().for_each(|&(x, cell)| tile.set(x, 0, cell));
        tile
    }

    #[test]
    fn a_newer_epoch_adds_to_an_older_one_in_any_order() {
        let old = update(1, 4, None, &tile(&[(0, Cell::Occupied), (1, Cell::Free)]));
        let new = update(2, 1, None, &tile(&[(1, Cell::Occupied), (2, Cell::Free)]));
        let joined = tile(&[(0, Cell::Occupied), (1, Cell::Occupied), (2, Cell::Free)]);
        for order in [[&old, &new], [&new, &old]] {
            let mut layer = RobotLayer::default();
            for coded in order {
                assert_eq!(layer.update(coded, 5).1, Ok(()));
            }
            assert_eq!(layer.tile(ID), joined);
            assert_eq!(layer.next_epoch(), Epoch(3));
        }
    }

    #[test]
    fn a_base_that_is_not_held_is_named_and_leaves_no_trace() {
        let base = tile(&[(0, Cell::Free)]);
        let coded = update(1, 2, Some((1, &base)), &tile(&[(0, Cell::Occupied)]));
        let mut layer = RobotLayer::default();
        let (updated, result) = layer.update(&coded, 5);
        assert_eq!((updated.missing, result), (Some(ID), Ok(())));
        assert!(updated.tiles.is_empty());
        assert_eq!(layer.tile(ID), Tile::UNKNOWN);
        assert_eq!(layer.update(&update(1, 1, None, &base), 5).1, Ok(()));
        assert_eq!(layer.update(&coded, 6).0.missing, None);
        assert_eq!(layer.tile(ID).cell(0, 0), Cell::Occupied);
        assert_eq!(layer.newest_scan(ID), Some(6));
    }
}
