//! The fused layer: what everybody gets.

use std::collections::BTreeMap;

use ubimap_protocol::message::Interest;
use ubimap_protocol::tile::{Digest, Row, Stamp, TILE_SIDE, Tile, TileId, Version, tile_hash};

/// Fuses one tile: what the cameras have seen, and what each robot has, in any order. A pure
/// function:
///
/// | the cameras | the robots | fused |
/// |---|---|---|
/// | know the cell | anything | the cameras' code |
/// | don't | none knows it | unknown |
/// | don't | as many or more say occupied as free | occupied |
/// | don't | more say free | free |
pub fn fuse(cameras: &Tile, robots: &[Tile]) -> Tile {
    let mut fused = *cameras;
    for y in 0..TILE_SIDE {
        let row = cameras.row(y);
        let voted = vote(robots.iter().map(|robot| robot.row(y)));
        let blind = !row.known();
        let low = row.low | voted.low & blind;
        let high = row.high | voted.high & blind;
        fused.set_row(y, Row { low, high });
    }
    fused
}

/// The majority of the robots that know a cell; a tie is occupied.
fn vote(rows: impl Iterator<Item = Row>) -> Row {
    let mut balance = [0i32; TILE_SIDE];
    let mut known = 0;
    for row in rows {
        known |= row.known();
        for (x, balance) in balance.iter_mut().enumerate() {
            if row.known() >> x & 1 != 0 {
                *balance += if row.high >> x & 1 != 0 { 1 } else { -1 };
            }
        }
    }
    let occupied = (0..TILE_SIDE).filter(|&x| balance[x] >= 0).fold(0, |word, x| word | 1u32 << x);
    Row { low: known & !occupied, high: known & occupied }
}

/// The tiles of the fused layer. The server alone writes them: a tile's version is raised
/// whenever it changes.
#[derive(Clone, Debug, Default)]
pub struct FusedLayer {
    tiles: BTreeMap<TileId, (Version, Tile)>,
}

impl FusedLayer {
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
    use ubimap_protocol::tile::Cell::{self, Free, Movable, Occupied, Unknown};

    fn of(cell: Cell) -> Tile {
        let mut tile = Tile::UNKNOWN;
        tile.set(7, 9, cell);
        tile
    }

    #[test]
    fn the_table_of_cases() {
        let cases: [(Cell, &[Cell], Cell); 9] = [
            (Unknown, &[], Unknown),
            (Unknown, &[Unknown, Unknown], Unknown),
            (Unknown, &[Free, Unknown], Free),
            (Unknown, &[Unknown, Occupied], Occupied),
            (Unknown, &[Free, Occupied], Occupied),
            (Unknown, &[Free, Occupied, Free], Free),
            (Free, &[Occupied, Occupied], Free),
            (Movable, &[Free], Movable),
            (Occupied, &[Free, Unknown], Occupied),
        ];
        for (camera, robots, expected) in cases {
            let mut robots: Vec<Tile> = robots.iter().map(|&cell| of(cell)).collect();
            for _ in 0..2 {
                let fused = fuse(&of(camera), &robots);
                assert_eq!(fused.cell(7, 9), expected, "{camera:?} and {robots:?}");
                assert_eq!(fused.counts().0, u32::from(expected != Unknown));
                robots.reverse();
            }
        }
    }

    #[test]
    fn a_version_is_raised_by_a_change_alone() {
        let mut layer = FusedLayer::default();
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
