//! Tiles of the map: bit planes, their stamps and hashes, and the codec of their updates.

mod cells;
mod codec;
mod context;
mod digest;
mod header;
#[cfg(test)]
mod plain;
mod planes;
mod range_coder;
mod replica;
mod stamp;

pub use codec::{MAX_TILES_PER_UPDATE, TileDecoder, TileEncoder, TileError};
use digest::BaseCheck;
pub use digest::{Digest, tile_hash};
pub use header::{TILE_CELLS, TileHeader};
pub use planes::{Cell, Layer, Row, TILE_SIDE, Tile, TileId, cell_of};
pub use replica::{Applied, BaseMissing, Publication, Replica};
pub use stamp::{EPOCHS_AHEAD, Epoch, Stamp, Version};
