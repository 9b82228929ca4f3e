//! The cells that cameras see now.

use std::collections::{BTreeMap, VecDeque};

use ubimap_protocol::{
    tile::{Cell, Row, TILE_SIDE, Tile, TileId},
    time::{Duration, Instant},
};

use super::{mask::Mask, runs::runs, served_layer::ServedLayer};
use crate::{camera::Observation, timing::COVERAGE_HOLDS};

/// Interval at which the layer is recomputed, so that the cells of a failed camera become uncovered
/// within a second.
const INTERVAL: Duration = Duration::from_millis(250);

/// The coverage layer: covered cells are free, all others unknown. Frames already exclude the cells
/// that the camera does not see, such as shadows and the floor below a robot.
#[derive(Clone, Debug, Default)]
pub struct CoverageLayer {
    /// Cells seen by recent frames, in order of arrival.
    frames: VecDeque<(Instant, BTreeMap<TileId, Mask>)>,
    served: ServedLayer,
    /// When to recompute the layer; `None` if nothing is covered.
    due: Option<Instant>,
}

impl CoverageLayer {
    /// Adds the cells of a frame. Frames may arrive in any order. Cost: a few nanoseconds per cell.
    pub fn observe(&mut self, observation: &Observation) {
        if observation.cells.is_empty() {
            return;
        }
        let mut seen = BTreeMap::<TileId, Mask>::new();
        for (id, cells) in runs(observation) {
            let mask = seen.entry(id).or_default();
            for (x, y, cell) in cells {
                mask[y] |= u32::from(cell != Cell::Unknown) << x;
            }
        }
        self.frames.push_back((observation.captured, seen));
        self.due = self.due.or(Some(observation.captured));
    }

    /// Recomputes the layer if it is due.
    pub fn refresh(&mut self, now: Instant) {
        if self.due.is_none_or(|due| due > now) {
            return;
        }
        // Includes tiles that were covered before, so that they can become uncovered.
        let mut covered: BTreeMap<TileId, Mask> =
            self.served.tiles().map(|(id, ..)| (id, [0; TILE_SIDE])).collect();
        self.frames.retain(|(captured, _)| now < *captured + COVERAGE_HOLDS);
        for (id, seen) in self.frames.iter().flat_map(|(_, tiles)| tiles) {
            let mask = covered.entry(*id).or_default();
            for (row, seen) in mask.iter_mut().zip(seen) {
                *row |= seen;
            }
        }
        for (id, mask) in covered {
            let mut tile = Tile::UNKNOWN;
            for (y, low) in mask.into_iter().enumerate() {
                // Free is code 1.
                tile.set_row(y, Row { low, high: 0 });
            }
            self.served.set(id, tile);
        }
        self.due = (!self.frames.is_empty()).then_some(now + INTERVAL);
    }

    /// The deadline for the next call of [`CoverageLayer::refresh`].
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.due
    }

    /// The tiles as of the last refresh.
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

    /// The covered columns of row -1 at `millis`, after all refreshes that are due.
    fn covered(layer: &mut CoverageLayer, millis: u64) -> Vec<usize> {
        while let Some(due) = layer.poll_timeout().filter(|due| due.0 <= millis * 1_000) {
            layer.refresh(due);
        }
        let tile = layer.served().get(ID).map_or(Tile::UNKNOWN, |(_, tile)| *tile);
        (0..TILE_SIDE).filter(|&x| tile.cell(x, 31) == Cell::Free).collect()
    }

    #[test]
    fn cells_of_a_dead_camera_are_uncovered_within_a_second() {
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
        // The last frame of any camera was captured at 4.5 s.
        assert!(covered(&mut layer, 5_500).is_empty());
        assert_eq!(layer.poll_timeout(), None);
    }

    #[test]
    fn cells_seen_by_two_cameras_stay_covered_when_one_dies() {
        let mut layer = CoverageLayer::default();
        // Camera 1 dies after 2 s. Frames of camera 0 arrive in swapped pairs.
        for millis in (0..4_000).step_by(200) {
            let swapped = (millis / 200) ^ 1;
            layer.observe(&frame(0, swapped * 200, 0..4));
            if millis <= 2_000 {
                layer.observe(&frame(1, millis, 2..6));
            }
            let expected = if millis < 2_900 { 0..6 } else { 0..4 };
            // Between these times both results are valid, because the layer is recomputed four
            // times per second.
            if !(2_700..3_000).contains(&millis) && millis > 0 {
                assert_eq!(covered(&mut layer, millis), expected.collect::<Vec<_>>(), "{millis}");
            }
        }
        // A frame that arrives a second late does not count.
        layer.observe(&frame(1, 2_900, 2..6));
        assert_eq!(covered(&mut layer, 4_100), [0, 1, 2, 3]);
    }

    #[test]
    fn shadows_are_uncovered_and_late_frames_revoke_nothing() {
        let mut layer = CoverageLayer::default();
        layer.observe(&frame(0, 0, 0..4));
        layer.observe(&frame(0, 900, 0..2));
        layer.observe(&frame(0, 100, 0..3));
        assert_eq!(covered(&mut layer, 1_000), [0, 1]);
    }
}
