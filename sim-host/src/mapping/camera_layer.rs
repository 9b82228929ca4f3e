//! What the cameras have seen: for each cell, what it was when it was last in view.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, Tile, TileId},
    time::Instant,
};

use crate::camera::Observation;

/// The camera evidence, and when the newest frame in each tile was captured.
#[derive(Clone, Debug, Default)]
pub struct CameraLayer {
    tiles: BTreeMap<TileId, (Tile, Instant)>,
}

impl CameraLayer {
    /// Takes the cells of a frame. A frame that is older than what is known of a tile is passed
    /// over there. Returns the tiles that have changed.
    pub fn observe(&mut self, observation: &Observation) -> BTreeSet<TileId> {
        let mut by_tile = BTreeMap::<TileId, Vec<(usize, usize, Cell)>>::new();
        for &((x, y), cell) in &observation.cells {
            let Some(id) = TileId::of_cell(x, y) else { continue };
            let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
            by_tile.entry(id).or_default().push((within(x), within(y), cell));
        }
        let mut changed = BTreeSet::new();
        for (id, cells) in by_tile {
            let (tile, newest) = self.tiles.entry(id).or_default();
            if observation.captured < *newest {
                continue;
            }
            *newest = observation.captured;
            for (x, y, cell) in cells {
                if tile.cell(x, y) != cell {
                    tile.set(x, y, cell);
                    changed.insert(id);
                }
            }
        }
        changed
    }

    /// What the cameras have seen of a tile.
    pub fn tile(&self, id: TileId) -> Tile {
        self.tiles.get(&id).map_or(Tile::UNKNOWN, |(tile, _)| *tile)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_frame_holds() {
        let mut layer = CameraLayer::default();
        let frame = |captured, cell| Observation {
            captured: Instant(captured),
            cells: vec![((-1, 5), cell)],
            ..Observation::default()
        };
        let id = TileId { x: -1, y: 0 };
        assert!(layer.observe(&frame(10, Cell::Movable)).contains(&id));
        assert!(layer.observe(&frame(20, Cell::Free)).contains(&id));
        assert!(layer.observe(&frame(15, Cell::Occupied)).is_empty());
        assert_eq!(layer.tile(id).cell(31, 5), Cell::Free);
    }
}
