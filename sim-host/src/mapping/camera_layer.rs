//! What the cameras have seen: for each cell, what stood or did not stand there when it was last
//! in view, and what moves there now.

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

/// The camera evidence.
#[derive(Clone, Debug, Default)]
pub struct CameraLayer {
    still: BTreeMap<TileId, Still>,
    /// What moves, as the newest frame of each camera has it: its next frame replaces it, so that
    /// what walks out of view leaves nothing behind.
    moving: BTreeMap<usize, (Instant, BTreeMap<TileId, Tile>)>,
    newest: Instant,
}

/// What does not move.
#[derive(Clone, Debug)]
struct Still {
    tile: Tile,
    /// For each cell, row by row, when the frame was captured that it comes from, and by whom.
    seen: Box<[(Instant, usize); TILE_CELLS as usize]>,
    /// Whether any of it was seen since the disk was told.
    is_unkept: bool,
}

/// What cameras have seen of a tile and does not move, to be kept on disk.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CameraTile {
    /// Which tile.
    pub id: TileId,
    /// Its cells, and when each was seen.
    pub seen: SeenTile,
    /// By which camera, in the order of [`SeenTile::seconds`].
    pub cameras: [u32; TILE_CELLS as usize],
}

impl CameraLayer {
    /// Takes the cells of a frame; a frame without cells says nothing. What is known from a newer
    /// frame stays. Returns the tiles that have changed.
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

    /// All tiles of which anything was seen since this was last called, without what moves.
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

    /// Some of what was taken to be kept could not be: it is taken again.
    pub fn not_kept(&mut self, tiles: &[CameraTile]) {
        for tile in tiles {
            if let Some(still) = self.still.get_mut(&tile.id) {
                still.is_unkept = true;
            }
        }
    }

    /// Whether [`CameraLayer::take_unkept`] has something.
    pub fn has_unkept(&self) -> bool {
        self.still.values().any(|still| still.is_unkept)
    }

    /// Takes back what was kept. What has been seen since stays.
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

    /// What the cameras know of a tile, and when they last saw each cell.
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

    /// What the cameras know of a tile.
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
    /// Takes what a camera says of a cell, free, occupied, or no longer known. Whether that changes
    /// it, or it has not been in view for a while.
    fn take(&mut self, x: usize, y: usize, cell: Cell, camera: usize, captured: Instant) -> bool {
        let known = self.tile.cell(x, y);
        let seen = &mut self.seen[y * TILE_SIDE + x];
        let (when, by) = *seen;
        let is_held = known == Cell::Occupied
            && cell == Cell::Free
            && by != camera
            && captured.since(when) <= EVIDENCE_HOLDS;
        // Only who said what stands there takes it back.
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
    fn the_newest_frame_holds() {
        let mut layer = CameraLayer::default();
        assert!(layer.observe(&frame(0, 10, &[(-1, Cell::Occupied)])).contains(&ID));
        assert!(layer.observe(&frame(0, 20, &[(-1, Cell::Free)])).contains(&ID));
        assert!(layer.observe(&frame(1, 15, &[(-1, Cell::Occupied)])).is_empty());
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

    #[test]
    fn whom_a_dead_camera_saw_last_is_gone_after_a_second() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(1, 0, &[(-1, Cell::Free), (-2, Cell::Free)]));
        layer.observe(&frame(0, 100_000, &[(-1, Cell::Movable)]));
        assert!(layer.observe(&frame(1, 1_100_000, &[(-2, Cell::Free)])).is_empty());
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Movable);
        assert!(layer.observe(&frame(1, 1_100_001, &[(-2, Cell::Free)])).contains(&ID));
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Free);
    }

    #[test]
    fn a_camera_that_sees_the_floor_before_a_wall_does_not_make_it_flicker() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(0, 0, &[(-1, Cell::Occupied)]));
        for turn in 1..10 {
            assert!(layer.observe(&frame(1, turn * 200_000, &[(-1, Cell::Free)])).is_empty());
            layer.observe(&frame(0, turn * 200_000 + 50_000, &[(-1, Cell::Occupied)]));
        }
        // The wall is taken down: at once if who saw it says so, else after a second.
        let mut other = layer.clone();
        assert!(layer.observe(&frame(0, 2_000_000, &[(-1, Cell::Free)])).contains(&ID));
        assert!(other.observe(&frame(1, 2_850_000, &[(-1, Cell::Free)])).is_empty());
        assert!(other.observe(&frame(1, 2_850_001, &[(-1, Cell::Free)])).contains(&ID));
    }

    #[test]
    fn a_cell_that_comes_back_into_view_is_told_of_and_each_has_its_second() {
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
    fn only_who_said_what_stands_there_takes_it_back() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(0, 10, &[(-1, Cell::Occupied)]));
        assert!(layer.observe(&frame(1, 20, &[(-1, Cell::Unknown)])).is_empty());
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Occupied);
        assert!(layer.observe(&frame(0, 30, &[(-1, Cell::Unknown)])).contains(&ID));
        assert_eq!(layer.tile(ID).cell(31, 5), Cell::Unknown);
    }

    #[test]
    fn a_camera_whose_frames_are_always_a_little_older_is_heard() {
        let mut layer = CameraLayer::default();
        layer.observe(&frame(0, 100, &[(-1, Cell::Free)]));
        layer.observe(&frame(1, 90, &[(-2, Cell::Occupied)]));
        assert_eq!(layer.tile(ID).cell(30, 5), Cell::Occupied);
    }
}
