//! The header of a tile in an update: its stamp, its base and its range of cells.

use core::ops::Range;

use super::{Stamp, TILE_SIDE, TileId, Version};

/// Number of cells in a tile.
pub const TILE_CELLS: u16 = (TILE_SIDE * TILE_SIDE) as u16;

/// The header of a tile, which precedes its cells in an update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TileHeader {
    /// The tile's id.
    pub id: TileId,
    /// The state of the tile once all parts have arrived.
    pub stamp: Stamp,
    /// The version (of the same epoch) that the update builds upon; `None` for a whole tile.
    pub base: Option<Version>,
    /// The first cell of this part; cells are numbered row by row from the south-west.
    pub start: u16,
    /// The cell after the last one of this part; 1,024 in the last part.
    pub end: u16,
}

impl TileHeader {
    /// Whether this is the first part of an update with a base: only then do both sides hold the
    /// whole base, whose cells the update checks.
    pub fn names_base(&self) -> bool {
        self.base.is_some() && self.start == 0
    }

    /// Whether this is the tile's last part.
    pub(super) fn ends_tile(&self) -> bool {
        self.end == TILE_CELLS
    }

    /// The rows in which this part has cells.
    pub(super) fn rows(&self) -> Range<usize> {
        usize::from(self.start) / TILE_SIDE..usize::from(self.end).div_ceil(TILE_SIDE)
    }
}
