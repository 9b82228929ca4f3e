//! Memory of simulated robots, on the heap.

use ubimap_agent::{
    Bounds, Storage,
    map::{OwnTile, RowSighting},
    sense::Beam,
    share::FusedTile,
};

use super::RunError;

/// Default bounds of a simulated robot: those of the firmware, with a queue of four scans.
pub const BOUNDS: Bounds = Bounds { waiting: 4, ..Bounds::DEFAULT };

/// Maximum number of tiles of all robots together: one to two gigabytes.
const MAX_TILES: usize = 1 << 19;

/// Refuses robots whose tiles would not fit into memory, before any is allocated.
pub(super) fn check_tiles(robots: usize, tiles: usize) -> Result<(), RunError> {
    if robots.saturating_mul(tiles) > MAX_TILES {
        return Err(RunError::TooManyTiles { robots, tiles, most: MAX_TILES });
    }
    Ok(())
}

/// Storage in vectors, sized at run time.
#[derive(Debug)]
pub struct Heap;

impl Storage for Heap {
    type Beams = Vec<Beam>;
    type Waiting = Vec<u16>;
    type Scratch = Vec<RowSighting>;
    type Own = Vec<OwnTile>;
    type Fused = Vec<FusedTile>;
}
