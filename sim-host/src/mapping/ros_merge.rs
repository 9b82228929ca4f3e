//! The rule of ROS `multirobot_map_merge`, for comparison: per cell, occupied beats free beats
//! unknown, so that an occupied cell stays occupied.

use std::collections::BTreeMap;

use ubimap_protocol::tile::{TILE_SIDE, Tile, TileId};

use super::runs::runs;
use crate::camera::Observation;

/// A map merged by that rule from the inputs of the fused layer. Inputs may come in any order and
/// repeatedly. Movable cells count as occupied.
#[derive(Clone, Debug, Default)]
pub struct RosMerge {
    tiles: BTreeMap<TileId, Tile>,
}

impl RosMerge {
    /// Merges the cells of a camera frame.
    pub fn observe(&mut self, observation: &Observation) {
        for (id, cells) in runs(observation) {
            let mut seen = Tile::UNKNOWN;
            cells.for_each(|(x, y, cell)| seen.set(x, y, cell));
            self.take(id, &seen);
        }
    }

    /// Merges the current state of a robot's tile.
    pub fn take(&mut self, id: TileId, seen: &Tile) {
        let merged = self.tiles.entry(id).or_default();
        for y in 0..TILE_SIDE {
            let (mut row, more) = (merged.row(y), seen.row(y));
            row.high |= more.high;
            row.low = (row.low | more.low) & !row.high;
            merged.set_row(y, row);
        }
    }

    /// The tiles, ordered by id.
    pub fn tiles(&self) -> impl Iterator<Item = (TileId, &Tile)> {
        self.tiles.iter().map(|(&id, tile)| (id, tile))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::tile::Cell::{self, Free, Movable, Occupied, Unknown};

    #[test]
    fn occupied_beats_free_beats_unknown_in_any_order() {
        const ID: TileId = TileId { x: -1, y: 0 };
        let codes = [Unknown, Free, Occupied, Movable];
        for (first, second) in codes.into_iter().flat_map(|a| codes.map(|b| (a, b))) {
            let mut merge = RosMerge::default();
            let cells = vec![((-5, 3), first)];
            merge.observe(&Observation { cells, ..Observation::default() });
            let mut seen = Tile::UNKNOWN;
            seen.set(27, 3, second);
            merge.take(ID, &seen);
            let expected = match first.code().max(second.code()) {
                2.. => Occupied,
                code => Cell::from_code(code),
            };
            let merged: Vec<(TileId, Cell)> =
                merge.tiles().map(|(id, tile)| (id, tile.cell(27, 3))).collect();
            assert_eq!(merged, [(ID, expected)], "{first:?} and {second:?}");
        }
    }
}
