//! Tiles of the map: bit planes and what is computed from them.

mod planes;

pub use planes::{Cell, Layer, Row, TILE_SIDE, Tile, TileId, cell_of};
