//! The fused layer: what everybody gets.

use std::collections::BTreeMap;

use ubimap_protocol::{
    message::Interest,
    tile::{Cell, Digest, Stamp, TILE_CELLS, TILE_SIDE, Tile, TileId, Version, tile_hash},
};

use super::robot_layer::SeenTile;

/// Fuses one tile: what the cameras have seen, and what each robot has, in any order. A pure
/// function:
///
/// | the cameras | the robots | fused |
/// |---|---|---|
/// | know the cell | anything | the cameras' code |
/// | don't | none knows it | unknown |
/// | don't | one said something new of it last | what that one said |
/// | don't | several did, within the same second | occupied if any of them says so |
///
/// A robot that agrees with the map is silent, so whoever spoke last has seen it otherwise.
pub fn fuse(cameras: &Tile, robots: &[&SeenTile]) -> Tile {
    let mut fused = *cameras;
    for cell in 0..usize::from(TILE_CELLS) {
        let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
        if cameras.cell(x, y) != Cell::Unknown {
            continue;
        }
        let said = robots.iter().map(|robot| (robot.tile.cell(x, y), robot.seconds[cell]));
        let known = said.filter(|(code, _)| *code != Cell::Unknown);
        // Of the codes, free is the least.
        if let Some((_, code)) = known.map(|(code, second)| (second, code.code())).max() {
            fused.set(x, y, Cell::from_code(code));
        }
    }
    fused
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
    use Cell::{Free, Movable, Occupied, Unknown};

    fn of(cell: Cell) -> Tile {
        let mut tile = Tile::UNKNOWN;
        tile.set(7, 9, cell);
        tile
    }

    fn seen(&(cell, second): &(Cell, u32)) -> SeenTile {
        SeenTile { tile: of(cell), seconds: [second; TILE_CELLS as usize] }
    }

    #[test]
    fn the_table_of_cases() {
        let cases: [(_, &[_], _); 9] = [
            (Unknown, &[], Unknown),
            (Unknown, &[(Unknown, 3), (Unknown, 4)], Unknown),
            (Unknown, &[(Free, 3), (Unknown, 4)], Free),
            (Unknown, &[(Free, 3), (Occupied, 3)], Occupied),
            (Unknown, &[(Free, 4), (Occupied, 3)], Free),
            (Unknown, &[(Free, 4), (Occupied, 3), (Movable, 4)], Movable),
            (Free, &[(Occupied, 3), (Occupied, 4)], Free),
            (Movable, &[(Free, 3)], Movable),
            (Occupied, &[(Free, 3), (Unknown, 4)], Occupied),
        ];
        for (camera, robots, expected) in cases {
            let robots: Vec<SeenTile> = robots.iter().map(seen).collect();
            let mut robots: Vec<&SeenTile> = robots.iter().collect();
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
