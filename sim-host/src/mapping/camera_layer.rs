//! What the cameras have seen: for each cell its last state apart from moving objects, and the
//! cells of objects that are moving now.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    tile::{Cell, TILE_CELLS, TILE_SIDE, Tile, TileId},
    time::Instant,
};

use super::{robot_layer::SeenTile, runs::runs};
use crate::{
    camera::Observation,
    timing::{CELL_AWAY, EVIDENCE_HOLDS},
};

/// The cameras' evidence.
#[derive(Clone, Debug, Default)]
pub struct CameraLayer {
    still: BTreeMap<TileId, Still>,
    /// Moving objects in the newest frame of each camera. The next frame replaces them, so that a
    /// person who walks out of view leaves no trace.
    moving: BTreeMap<usize, (Instant, BTreeMap<TileId, Tile>)>,
    newest: Instant,
}

/// The stationary part of a tile.
#[derive(Clone, Debug)]
struct Still {
    tile: Tile,
    /// For each cell, row by row: the capture time of the frame that set it, and its camera.
    seen: Box<[(Instant, usize); TILE_CELLS as usize]>,
    /// Whether the tile was observed since it was last taken for storage.
    is_unkept: bool,
}

/// The stationary cells that cameras have seen in a tile, as stored on disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CameraTile {
    /// The tile's id.
    pub id: TileId,
    /// The cells, and when each was last seen.
    pub seen: SeenTile,
    /// The camera that saw each cell, in the order of [`SeenTile::seconds`].
    pub cameras: [u32; TILE_CELLS as usize],
}

impl CameraLayer {
    /// Adds the cells of a frame, except those known from a newer one; a frame without cells has no
    /// effect. Returns the tiles that have changed, or have cells that were out of view for longer
    /// than [`CELL_AWAY`].
    pub fn observe(&mut self, observation: &Observation) -> BTreeSet<TileId> {
        let mut changed = BTreeSet::new();
        if observation.cells.is_empty() {
            return changed;
        }
        let (camera, captured) = (observation.camera, observation.captured);
        let mut moving = BTreeMap::<TileId, Tile>::new();
        for (id, cells) in runs(observation) {
            let still = self.still.entry(id).or_default();
            for (x, y, cell) in cells {
                if cell == Cell::Movable {
                    moving.entry(id).or_default().set(x, y, cell);
                } else if still.take(x, y, cell, camera, captured) {
                    changed.insert(id);
                }
            }
        }
        let (newest, tiles) = self.moving.entry(camera).or_default();
        if captured >= *newest {
            changed.extend(
                moving.keys().chain(tiles.keys()).filter(|id| moving.get(id) != tiles.get(id)),
            );
            (*newest, *tiles) = (captured, moving);
        }
        self.newest = self.newest.max(captured);
        self.moving.retain(|_, (captured, tiles)| {
            let holds = self.newest.since(*captured) <= EVIDENCE_HOLDS;
            changed.extend(tiles.keys().filter(|_| !holds));
            holds
        });
        changed
    }

    /// Forgets what a camera has seen after `since`. Returns the tiles that have changed.
    pub fn forget(&mut self, camera: usize, since: Instant) -> BTreeSet<TileId> {
        let mut changed = BTreeSet::new();
        for (&id, still) in &mut self.still {
            for (cell, (seen, by)) in still.seen.iter_mut().enumerate() {
                if *by == camera && *seen > since {
                    *seen = since;
                    still.tile.set(cell % TILE_SIDE, cell / TILE_SIDE, Cell::Unknown);
                    still.is_unkept = true;
                    changed.insert(id);
                }
            }
        }
        let moving = self.moving.remove(&camera);
        changed.extend(moving.into_iter().flat_map(|(_, tiles)| tiles.into_keys()));
        changed
    }

    /// Returns the stationary cells of all tiles observed since the last call.
    pub fn take_unkept(&mut self) -> Vec<CameraTile> {
        let unkept = self.still.iter_mut().filter(|(_, still)| still.is_unkept);
        let tiles = unkept.map(|(&id, still)| {
            still.is_unkept = false;
            let seconds = core::array::from_fn(|cell| second(still.seen[cell].0));
            let cameras = core::array::from_fn(|cell| still.seen[cell].1 as u32);
            CameraTile { id, seen: SeenTile { tile: still.tile, seconds }, cameras }
        });
        tiles.collect()
    }

    /// Marks tiles that could not be stored, so that the next [`CameraLayer::take_unkept`] returns
    /// them again.
    pub fn not_kept(&mut self, tiles: &[CameraTile]) {
        for tile in tiles {
            if let Some(still) = self.still.get_mut(&tile.id) {
                still.is_unkept = true;
            }
        }
    }

    /// Whether [`CameraLayer::take_unkept`] would return anything.
    pub fn has_unkept(&self) -> bool {
        self.still.values().any(|still| still.is_unkept)
    }

    /// Restores a stored tile. Newer observations are kept.
    pub fn restore(&mut self, kept: &CameraTile) {
        let still = self.still.entry(kept.id).or_default();
        for (cell, (&second, &camera)) in kept.seen.seconds.iter().zip(&kept.cameras).enumerate() {
            let (x, y) = (cell % TILE_SIDE, cell / TILE_SIDE);
            let moment = Instant(u64::from(second) * 1_000_000);
            if still.seen[cell].0 <= moment {
                still.seen[cell] = (moment, camera as usize);
                still.tile.set(x, y, kept.seen.tile.cell(x, y));
            }
        }
    }

    /// What the cameras know of a tile, with the time at which each cell was last seen.
    pub fn seen(&self, id: TileId) -> SeenTile {
        let mut seen = SeenTile { tile: self.tile(id), ..SeenTile::NOTHING };
        if let Some(still) = self.still.get(&id) {
            seen.seconds = core::array::from_fn(|cell| second(still.seen[cell].0));
        }
        for (captured, tiles) in self.moving.values() {
            for y in tiles.contains_key(&id).then_some(0..TILE_SIDE).into_iter().flatten() {
                let moving = tiles[&id].row(y).known();
                for x in (0..TILE_SIDE).filter(|x| moving >> x & 1 == 1) {
                    let last = &mut seen.seconds[y * TILE_SIDE + x];
                    *last = second(*captured).max(*last);
                }
            }
        }
        seen
    }

    /// What the cameras know of a tile, including moving objects.
    pub fn tile(&self, id: TileId) -> Tile {
        let mut tile = Tile::UNKNOWN;
        for moving in self.moving.values().filter_map(|(_, tiles)| tiles.get(&id)) {
            tile.fill_unknown_from(moving);
        }
        if let Some(still) = self.still.get(&id) {
            tile.fill_unknown_from(&still.tile);
        }
        tile
    }
}

fn second(moment: Instant) -> u32 {
    (moment.micros() / 1_000_000) as u32
}

impl Default for Still {
    fn default() -> Self {
        let seen = Box::new([(Instant::default(), 0); TILE_CELLS as usize]);
        Self { tile: Tile::UNKNOWN, seen, is_unkept: false }
    }
}

impl Still {
    /// Sets a cell as a camera reports it: free, occupied or (no longer) unknown. Returns whether
    /// its state has changed, or it was out of view for longer than [`CELL_AWAY`].
    fn take(&mut self, x: usize, y: usize, cell: Cell, camera: usize, captured: Instant) -> bool {
        let known = self.tile.cell(x, y);
        let seen = &mut self.seen[y * TILE_SIDE + x];
        let (when, by) = *seen;
        let is_held = known == Cell::Occupied
            && cell == Cell::Free
            && by != camera
            && captured.since(when) <= EVIDENCE_HOLDS;
        // Only the camera that set a cell can make it unknown again.
        let is_anothers = cell == Cell::Unknown && by != camera;
        if captured < when || is_held || is_anothers {
            return false;
        }
        *seen = (captured, camera);
        self.is_unkept = true;
        self.tile.set(x, y, cell);
        known != cell || captured.since(when) > CELL_AWAY
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
    fn the_newest_frame_wins() {
        let mut layer = CameraLayer::default();
        assert!(layer.observe(&frame(0, 10, &[(-1, Cell::Occupied)])).contains(&ID));
        assert!(layer.observe(&frame(0, 20, &[(-1, Cell::Free)])).contains(&ID));
        assert!(layer.observe(&frame(1, 15, &[(-1, Cell::Occupied)])).is_empty());
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Free);
    }

    #[test]
    fn a_person_who_walks_out_of_view_leaves_no_trace() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(0, 10, &[(-1, Cell::Free), (-2, Cell::Movable)]));
        layer.observe(&frame(0, 20, &[(-1, Cell::Movable), (-2, Cell::Free)]));
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Movable);
        // The person's shadow hides the previous position of the person.
        assert!(layer.observe(&frame(0, 30, &[(-2, Cell::Free)])).contains(&ID));
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Free);
        // A frame without cells has no effect.
        layer.observe(&frame(0, 40, &[]));
        assert_eq!(layer.tile(ID).cell(30, 5), Cell::Free);
    }

    #[test]
    fn a_person_seen_by_a_dead_camera_disappears_after_a_second() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(1, 0, &[(-1, Cell::Free), (-2, Cell::Free)]));
        layer.observe(&frame(0, 100_000, &[(-1, Cell::Movable)]));
        assert!(layer.observe(&frame(1, 1_100_000, &[(-2, Cell::Free)])).is_empty());
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Movable);
        assert!(layer.observe(&frame(1, 1_100_001, &[(-2, Cell::Free)])).contains(&ID));
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Free);
    }

    #[test]
    fn two_cameras_that_disagree_do_not_make_a_wall_flicker() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(0, 0, &[(-1, Cell::Occupied)]));
        for turn in 1..10 {
            assert!(layer.observe(&frame(1, turn * 200_000, &[(-1, Cell::Free)])).is_empty());
            layer.observe(&frame(0, turn * 200_000 + 50_000, &[(-1, Cell::Occupied)]));
        }
        // The wall is removed: its own camera removes it at once, another camera after a second.
        let mut other = layer.clone();
        assert!(layer.observe(&frame(0, 2_000_000, &[(-1, Cell::Free)])).contains(&ID));
        assert!(other.observe(&frame(1, 2_850_000, &[(-1, Cell::Free)])).is_empty());
        assert!(other.observe(&frame(1, 2_850_001, &[(-1, Cell::Free)])).contains(&ID));
    }

    #[test]
    fn a_cell_that_returns_to_view_counts_as_changed() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(0, 1_000_000, &[(-1, Cell::Free), (-2, Cell::Free)]));
        assert!(layer.observe(&frame(0, 2_500_000, &[(-1, Cell::Free)])).is_empty());
        assert!(layer.observe(&frame(0, 2_500_001, &[(-2, Cell::Free)])).contains(&ID));
        layer.observe(&frame(0, 4_000_000, &[(-3, Cell::Movable)]));
        let seen = layer.seen(ID);
        assert_eq!(seen.tile, layer.tile(ID));
        let row = 5 * TILE_SIDE;
        assert_eq!(seen.seconds[row + 28..row + TILE_SIDE], [0, 4, 2, 2]);
    }

    #[test]
    fn only_the_camera_that_set_a_cell_makes_it_unknown() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(0, 10, &[(-1, Cell::Occupied)]));
        assert!(layer.observe(&frame(1, 20, &[(-1, Cell::Unknown)])).is_empty());
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Occupied);
        assert!(layer.observe(&frame(0, 30, &[(-1, Cell::Unknown)])).contains(&ID));
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Unknown);
    }

    #[test]
    fn what_a_knocked_camera_saw_is_forgotten() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(0, 10, &[(-1, Cell::Occupied), (-2, Cell::Free)]));
        layer.observe(&frame(1, 15, &[(-3, Cell::Free)]));
        layer.observe(&frame(0, 20, &[(-2, Cell::Occupied), (-4, Cell::Movable)]));
        layer.take_unkept();
        assert!(layer.forget(0, Instant(10)).contains(&ID) && layer.has_unkept());
        let row: Vec<Cell> = (28..32).map(|x| layer.tile(ID).cell(x, 5)).collect();
        assert_eq!(row, [Cell::Unknown, Cell::Free, Cell::Unknown, Cell::Occupied]);
        assert!(layer.forget(0, Instant(10)).is_empty());
    }

    #[test]
    fn slightly_older_frames_of_a_second_camera_count() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(0, 100, &[(-1, Cell::Free)]));
        layer.observe(&frame(1, 90, &[(-2, Cell::Occupied)]));
        assert_eq!(layer.tile(ID).cell(30, 5), Cell::Occupied);
    }
}
