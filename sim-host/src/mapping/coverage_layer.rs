//! Which cells the cameras see now.

use std::collections::BTreeMap;

use ubimap_protocol::{
    tile::{Cell, TILE_CELLS, TILE_SIDE, Tile, TileId},
    time::{Duration, Instant},
};

use super::served_layer::ServedLayer;
use crate::camera::Observation;

/// A cell is covered for so long after the frame was captured in which a camera saw it. Cells are
/// looked at twice a second.
const COVERED_FOR: Duration = Duration::from_millis(700);
/// The layer is computed anew this often: a camera that dies leaves its cells blind within a second.
const INTERVAL: Duration = Duration::from_millis(250);

/// The coverage layer: free cells are covered, all others are not. What no camera sees is left out
/// by the frames themselves: shadows, and the floor beneath a robot.
#[derive(Clone, Debug, Default)]
pub struct CoverageLayer {
    /// When the newest frame was captured that saw each cell, row by row from the south-west.
    seen: BTreeMap<TileId, Box<[Option<Instant>; TILE_CELLS as usize]>>,
    served: ServedLayer,
    /// When to compute it anew, as long as anything is covered or was.
    due: Option<Instant>,
}

impl CoverageLayer {
    /// Takes the cells of a frame, in any order of frames.
    pub fn observe(&mut self, observation: &Observation) {
        let captured = Some(observation.captured);
        for &((x, y), _) in &observation.cells {
            let Some(id) = TileId::of_cell(x, y) else { continue };
            let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
            let cells =
                self.seen.entry(id).or_insert_with(|| Box::new([None; TILE_CELLS as usize]));
            let seen = &mut cells[within(y) * TILE_SIDE + within(x)];
            *seen = captured.max(*seen);
        }
        if !observation.cells.is_empty() {
            self.due = self.due.or(captured);
        }
    }

    /// Computes the layer anew if it is time.
    pub fn refresh(&mut self, now: Instant) {
        if self.due.is_none_or(|due| due > now) {
            return;
        }
        self.seen.retain(|&id, cells| {
            let mut tile = Tile::UNKNOWN;
            for (cell, seen) in cells.iter().enumerate() {
                if seen.is_some_and(|seen| now < seen + COVERED_FOR) {
                    tile.set(cell % TILE_SIDE, cell / TILE_SIDE, Cell::Free);
                }
            }
            self.served.set(id, tile);
            tile != Tile::UNKNOWN
        });
        self.due = (!self.seen.is_empty()).then_some(now + INTERVAL);
    }

    /// When to call [`CoverageLayer::refresh`].
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.due
    }

    /// The tiles, as they were computed last.
    pub fn served(&self) -> &ServedLayer {
        &self.served
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ID: TileId = TileId { x: 0, y: -1 };

    fn frame(camera: usize, millis: u64, columns: core::ops::Range<i32>) -> Observation {
        Observation {
            camera,
            captured: Instant(millis * 1_000),
            cells: columns.map(|x| ((x, -1), Cell::Occupied)).collect(),
            ..Observation::default()
        }
    }

    /// The columns of row -1 that are covered, after the layer was refreshed whenever it asked to.
    fn covered(layer: &mut CoverageLayer, millis: u64) -> Vec<usize> {
        while let Some(due) = layer.poll_timeout().filter(|due| due.0 <= millis * 1_000) {
            layer.refresh(due);
        }
        let tile = layer.served().get(ID).map_or(Tile::UNKNOWN, |(_, tile)| *tile);
        (0..TILE_SIDE).filter(|&x| tile.cell(x, 31) == Cell::Free).collect()
    }

    #[test]
    fn a_camera_that_dies_leaves_its_cells_blind_within_a_second() {
        let mut layer = CoverageLayer::default();
        for millis in (0..5_000).step_by(500) {
            layer.observe(&frame(0, millis, 0..4));
            if millis <= 3_000 {
                layer.observe(&frame(1, millis + 100, 3..6));
            }
            let expected = if millis <= 3_500 { 0..6 } else { 0..4 };
            if millis > 0 {
                assert_eq!(covered(&mut layer, millis + 99), expected.collect::<Vec<_>>());
            }
        }
        // The last frame of all was captured at 4.5 s.
        assert!(covered(&mut layer, 5_500).is_empty());
        assert_eq!(layer.poll_timeout(), None);
    }

    #[test]
    fn a_shadow_is_not_covered_and_late_frames_take_nothing_back() {
        let mut layer = CoverageLayer::default();
        layer.observe(&frame(0, 0, 0..4));
        layer.observe(&frame(0, 900, 0..2));
        layer.observe(&frame(0, 100, 0..3));
        assert_eq!(covered(&mut layer, 1_000), [0, 1]);
    }
}
