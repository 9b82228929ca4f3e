//! The robot layer: what this robot has seen, in a fixed pool of tiles.

use ubimap_protocol::{
    tile::{TILE_SIDE, Tile, TileId},
    units::Pose,
};

use super::{
    evidence::RowSighting,
    own_tile::{OwnTile, Pool},
    sighting::{PixelCounts, Sighting, SightingConfig},
};
use crate::sense::Beam;

/// What mapping a scan came to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mapped {
    /// How its readings fared.
    pub pixels: PixelCounts,
    /// Cells that it said something of and that found no room in the pool.
    pub cells_refused: u32,
}

/// The map of one robot.
#[derive(Debug)]
pub struct LocalMap<'b> {
    config: SightingConfig,
    scratch: &'b mut [u32],
    /// The tiles.
    pub pool: Pool<'b>,
    scans: u32,
}

impl<'b> LocalMap<'b> {
    /// A map without a cell. `scratch` must have [`scratch_words`](super::scratch_words).
    pub fn new(config: SightingConfig, scratch: &'b mut [u32], pool: Pool<'b>) -> Self {
        Self { config, scratch, pool, scans: 0 }
    }

    /// The sensor is mounted otherwise from now on.
    pub(crate) fn remount(&mut self, mounting: Pose) {
        self.config.mounting = mounting;
    }

    /// Adds a scan that was taken at `pose` (`base_link` in `map`). `merged` gives a tile of the
    /// server's map, if it is held. `None` if the map does not reach there.
    pub fn add<'m>(
        &mut self,
        beams: &[Beam],
        readings: &[u16],
        pose: Pose,
        merged: impl Fn(TileId) -> Option<&'m Tile>,
    ) -> Option<Mapped> {
        self.scans = self.scans.wrapping_add(1);
        let pool = &self.pool;
        // Omission: a hit in a cell that is known to be occupied, by the server's map or for as
        // certain as can be. Scans touch a few tiles only, neighbouring beams mostly the same.
        let mut last = None;
        let omit = |x: i32, y: i32| {
            let Some(id) = TileId::of_cell(x, y) else { return false };
            let (own, merged) = match last {
                Some((last_id, own, merged)) if last_id == id => (own, merged),
                _ => (pool.find(id), merged(id)),
            };
            last = Some((id, own, merged));
            let (bit, y) =
                (x.rem_euclid(TILE_SIDE as i32), y.rem_euclid(TILE_SIDE as i32) as usize);
            let merged = merged.map_or(0, |tile| tile.row(y).high);
            let known = own.map_or(merged, |tile: &OwnTile| {
                tile.evidence.certain(y) | merged & tile.evidence.unknown(y)
            });
            known >> bit & 1 != 0
        };
        let (sighting, pixels) =
            Sighting::of_scan(&self.config, beams, readings, pose, self.scratch, omit)?;
        let mut mapped = Mapped { pixels, cells_refused: 0 };
        for id in sighting.tiles() {
            let rows = (0..TILE_SIDE).map(|y| (y, sighting.tile_row(id, y)));
            match self.pool.find_or_begin(id, self.scans) {
                Some(tile) => {
                    let merged = merged(id).unwrap_or(&Tile::UNKNOWN);
                    rows.for_each(|(y, row)| tile.evidence.add(y, row, merged.row(y)));
                    tile.dirty = true;
                }
                None => {
                    let cells = |row: RowSighting| (row.free | row.hit).count_ones();
                    mapped.cells_refused += rows.map(|(_, row)| cells(row)).sum::<u32>();
                }
            }
        }
        Some(mapped)
    }
}
