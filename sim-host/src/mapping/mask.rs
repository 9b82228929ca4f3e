//! A set of cells of a tile.

use ubimap_protocol::tile::TILE_SIDE;

/// Cells of a tile: one word per row, one bit per cell.
pub type Mask = [u32; TILE_SIDE];
