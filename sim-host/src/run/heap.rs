//! Memory of simulated robots, on the heap.

use ubimap_agent::{
    Bounds, Storage,
    map::{OwnTile, RowSighting},
    sense::Beam,
    share::FusedTile,
};

/// Default bounds of a simulated robot: those of the firmware, with a queue of four scans.
pub const BOUNDS: Bounds = Bounds { waiting: 4, ..Bounds::DEFAULT };

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
