//! Which part of a tile an update holds, and what it builds upon.

use core::ops::Range;

use super::{Stamp, TILE_SIDE, TileId, Version};

/// Cells of a tile, row by row from the south-west.
pub const TILE_CELLS: u16 = (TILE_SIDE * TILE_SIDE) as u16;

/// What precedes the cells of one tile in an update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TileHeader {
    /// Which tile.
    pub id: TileId,
    /// The state that the tile is in once all parts have arrived.
    pub stamp: Stamp,
    /// The version (of the same epoch) that it builds upon; `None`: on nothing, it is whole.
    pub base: Option<Version>,
    /// The first cell of this part, row by row from the south-west.
    pub start: u16,
    /// The cell after the last of this part; 1,024 ends the tile.
    pub end: u16,
}

impl TileHeader {
    /// Whether the part is the tile's last.
    pub(super) fn ends_tile(&self) -> bool {
        self.end == TILE_CELLS
    }

    /// The rows that the part has cells of.
    pub(super) fn rows(&self) -> Range<usize> {
        usize::from(self.start) / TILE_SIDE..usize::from(self.end).div_ceil(TILE_SIDE)
    }
}
