//! What the cameras have seen: for each cell, what stood or did not stand there when it was last
//! in view, and what moves there now.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, Tile, TileId},
    time::Instant,
};

use crate::camera::Observation;

/// The camera evidence.
#[derive(Clone, Debug, Default)]
pub struct CameraLayer {
    /// What does not move, and when the newest frame in each tile was captured.
    still: BTreeMap<TileId, (Tile, Instant)>,
    /// What moves, as the newest frame of each camera has it: its next frame replaces it, so that
    /// what walks out of view leaves nothing behind.
    moving: BTreeMap<usize, (Instant, BTreeMap<TileId, Tile>)>,
}

impl CameraLayer {
    /// Takes the cells of a frame; a frame without cells says nothing. A frame that is older than
    /// what is known is passed over. Returns the tiles that have changed.
    pub fn observe(&mut self, observation: &Observation) -> BTreeSet<TileId> {
        if observation.cells.is_empty() {
            return BTreeSet::new();
        }
        let captured = observation.captured;
        let mut moving = BTreeMap::<TileId, Tile>::new();
        let mut still = BTreeMap::<TileId, Tile>::new();
        for &((x, y), cell) in &observation.cells {
            let Some(id) = TileId::of_cell(x, y) else { continue };
            let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
            let tiles = if cell == Cell::Movable { &mut moving } else { &mut still };
            tiles.entry(id).or_default().set(within(x), within(y), cell);
        }
        let mut changed = BTreeSet::new();
        for (id, mut seen) in still {
            let (tile, newest) = self.still.entry(id).or_default();
            if captured < *newest {
                continue;
            }
            *newest = captured;
            seen.fill_unknown_from(tile);
            if seen != *tile {
                *tile = seen;
                changed.insert(id);
            }
        }
        let (newest, tiles) = self.moving.entry(observation.camera).or_default();
        if captured >= *newest {
            changed.extend(
                moving.keys().chain(tiles.keys()).filter(|id| moving.get(id) != tiles.get(id)),
            );
            (*newest, *tiles) = (captured, moving);
        }
        changed
    }

    /// What the cameras know of a tile.
    pub fn tile(&self, id: TileId) -> Tile {
        let mut tile = Tile::UNKNOWN;
        for moving in self.moving.values().filter_map(|(_, tiles)| tiles.get(&id)) {
            tile.fill_unknown_from(moving);
        }
        if let Some((still, _)) = self.still.get(&id) {
            tile.fill_unknown_from(still);
        }
        tile
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ID: TileId = TileId { x: -1, y: 0 };

    fn frame(camera: usize, captured: u64, cells: &[(i32, Cell)]) -> Observation {
        Observation {
            camera,
            captured: Instant(captured),
            cells: cells.iter().map(|&(x, cell)| ((x, 5), cell)).collect(),
            ..Observation::default()
        }
    }

    #[test]
    fn the_newest_frame_holds() {
        let mut layer = CameraLayer::default();
        assert!(layer.observe(&frame(0, 10, &[(-1, Cell::Occupied)])).contains(&ID));
        assert!(layer.observe(&frame(1, 20, &[(-1, Cell::Free)])).contains(&ID));
        assert!(layer.observe(&frame(0, 15, &[(-1, Cell::Occupied)])).is_empty());
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Free);
    }

    #[test]
    fn what_walks_out_of_view_leaves_nothing_behind() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(0, 10, &[(-1, Cell::Free), (-2, Cell::Movable)]));
        layer.observe(&frame(0, 20, &[(-1, Cell::Movable), (-2, Cell::Free)]));
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Movable);
        // Its shadow hides where it was.
        assert!(layer.observe(&frame(0, 30, &[(-2, Cell::Free)])).contains(&ID));
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Free);
        // A frame without cells says nothing.
        layer.observe(&frame(0, 40, &[]));
        assert_eq!(layer.tile(ID).cell(30, 5), Cell::Free);
    }
}
