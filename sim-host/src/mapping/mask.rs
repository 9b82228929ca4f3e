//! A set of cells of a tile.

use ubimap_protocol::tile::TILE_SIDE;

/// Cells of a tile: a word for each row, a bit for each cell.
pub type Mask = [u32; TILE_SIDE];
