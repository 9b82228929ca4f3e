//! A layer that the server writes and robots read.

use std::collections::BTreeMap;

use ubimap_protocol::{
    message::Interest,
    tile::{Digest, Stamp, Tile, TileId, Version, tile_hash},
};

/// Tiles that only the server writes; each change increments the tile's version.
#[derive(Clone, Debug, Default)]
pub struct ServedLayer {
    tiles: BTreeMap<TileId, (Version, Tile)>,
}

impl ServedLayer {
    /// Sets a tile. Returns whether it has changed.
    pub fn set(&mut self, id: TileId, tile: Tile) -> bool {
        let entry = self.tiles.entry(id).or_default();
        let changed = entry.1 != tile;
        if changed {
            *entry = (Version(entry.0.0.wrapping_add(1)), tile);
        }
        changed
    }

    /// The version and cells of a tile.
    pub fn get(&self, id: TileId) -> Option<(Version, &Tile)> {
        self.tiles.get(&id).map(|(version, tile)| (*version, tile))
    }

    /// All tiles that ever had known cells, ordered by id.
    pub fn tiles(&self) -> impl Iterator<Item = (TileId, Version, &Tile)> {
        let known = self.tiles.iter().filter(|(_, (version, _))| version.0 > 0);
        known.map(|(&id, (version, tile))| (id, *version, tile))
    }

    /// The tiles of a window that ever had known cells, ordered by id.
    pub fn within(&self, window: &Interest) -> impl Iterator<Item = (TileId, Version, &Tile)> {
        let (low, high) = (window.from.y, window.to.y.max(window.from.y));
        (window.from.x..=window.to.x)
            .flat_map(move |x| self.tiles.range(TileId { x, y: low }..=TileId { x, y: high }))
            .filter(|(_, (version, _))| version.0 > 0)
            .map(|(&id, (version, tile))| (id, *version, tile))
    }

    /// The digest of the cells, independent of versions.
    pub fn digest(&self) -> Digest {
        let mut digest = Digest::default();
        for (id, _, tile) in self.tiles().filter(|(.., tile)| **tile != Tile::UNKNOWN) {
            digest.add(id, Stamp::default(), tile_hash(tile));
        }
        digest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::tile::Cell::{self, Free, Occupied};

    fn of(cell: Cell) -> Tile {
        let mut tile = Tile::UNKNOWN;
        tile.set(7, 9, cell);
        tile
    }

    #[test]
    fn only_a_change_increments_the_version() {
        let mut layer = ServedLayer::default();
        let id = TileId::default();
        assert!(layer.set(id, of(Free)));
        assert!(!layer.set(id, of(Free)));
        let digest = layer.digest();
        assert!(layer.set(id, of(Occupied)));
        assert_eq!(layer.get(id).unwrap().0, Version(2));
        assert_ne!(layer.digest(), digest);
        layer.set(id, of(Free));
        assert_eq!(layer.digest(), digest);
    }
}
