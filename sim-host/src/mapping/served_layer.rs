//! A layer that the server writes and the robots read.

use std::collections::BTreeMap;

use ubimap_protocol::{
    message::Interest,
    tile::{Digest, Stamp, Tile, TileId, Version, tile_hash},
};

/// Tiles that the server alone writes: a tile's version is raised whenever it changes.
#[derive(Clone, Debug, Default)]
pub struct ServedLayer {
    tiles: BTreeMap<TileId, (Version, Tile)>,
}

impl ServedLayer {
    /// Takes the present state of a tile. Whether it has changed.
    pub fn set(&mut self, id: TileId, tile: Tile) -> bool {
        let entry = self.tiles.entry(id).or_default();
        let changed = entry.1 != tile;
        if changed {
            *entry = (Version(entry.0.0.wrapping_add(1)), tile);
        }
        changed
    }

    /// A tile, and its version.
    pub fn get(&self, id: TileId) -> Option<(Version, &Tile)> {
        self.tiles.get(&id).map(|(version, tile)| (*version, tile))
    }

    /// All tiles of which something is known, in order of their ids.
    pub fn tiles(&self) -> impl Iterator<Item = (TileId, Version, &Tile)> {
        let known = self.tiles.iter().filter(|(_, (version, _))| version.0 > 0);
        known.map(|(&id, (version, tile))| (id, *version, tile))
    }

    /// The tiles of a rectangle of which something is known, in order of their ids.
    pub fn within(&self, window: &Interest) -> impl Iterator<Item = (TileId, Version, &Tile)> {
        let (low, high) = (window.from.y, window.to.y.max(window.from.y));
        (window.from.x..=window.to.x)
            .flat_map(move |x| self.tiles.range(TileId { x, y: low }..=TileId { x, y: high }))
            .filter(|(_, (version, _))| version.0 > 0)
            .map(|(&id, (version, tile))| (id, *version, tile))
    }

    /// The digest of the cells, whatever the versions by which they came about.
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
    fn a_version_is_raised_by_a_change_alone() {
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
