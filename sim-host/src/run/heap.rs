//! The memory of robots on a machine with a heap.

use ubimap_agent::{
    Bounds, Storage,
    map::{OwnTile, RowSighting},
    sense::Beam,
    share::FusedTile,
};

/// What a simulated robot keeps, unless a run says otherwise: as much as a real one.
pub const BOUNDS: Bounds = Bounds { waiting: 4, ..Bounds::DEFAULT };

/// Vectors, whose sizes are known only when the program runs.
#[derive(Debug)]
pub struct Heap;

impl Storage for Heap {
    type Beams = Vec<Beam>;
    type Waiting = Vec<u16>;
    type Scratch = Vec<RowSighting>;
    type Own = Vec<OwnTile>;
    type Fused = Vec<FusedTile>;
}
