//! What the memory of an agent comes to, by bounds that are chosen at compile time.

use ubimap_protocol::units::Millimetres;

use crate::{
    agent::Agent,
    map::{OwnTile, RowSighting, scratch_words},
    sense::Beam,
    share::FusedTile,
};

/// How much an agent can keep: the lengths of its [`Memory`](crate::Memory).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bounds {
    /// Readings of a scan.
    pub readings: usize,
    /// Scans that can wait for their poses.
    pub waiting: usize,
    /// Tiles of its own.
    pub own_tiles: usize,
    /// Fused tiles.
    pub fused_tiles: usize,
    /// What is mapped of a scan, in millimetres.
    pub max_range: u16,
    /// The side of the map's cells.
    pub resolution: Millimetres,
}

impl Bounds {
    /// A depth camera's row of 640 pixels, and a chip like the reference board's.
    pub const DEFAULT: Self = Self {
        readings: 640,
        waiting: 2,
        own_tiles: 32,
        fused_tiles: 64,
        max_range: 4_000,
        resolution: Millimetres(50),
    };

    /// A row of 100 pixels, and the firmware of the reference board: as far as a pool of eight
    /// tiles holds, in a window of 4 x 4.
    pub const REFERENCE: Self =
        Self { readings: 100, own_tiles: 8, fused_tiles: 16, max_range: 2_000, ..Self::DEFAULT };

    /// A row of 64 pixels, and a Cortex-M0+.
    pub const SMALL: Self =
        Self { readings: 64, own_tiles: 8, fused_tiles: 12, max_range: 2_000, ..Self::DEFAULT };

    /// Words of scratch memory.
    pub const fn scratch(&self) -> usize {
        scratch_words(self.max_range, self.resolution)
    }

    /// Bytes of the tiles.
    pub const fn tile_bytes(&self) -> usize {
        self.own_tiles * size_of::<OwnTile>() + self.fused_tiles * size_of::<FusedTile>()
    }

    /// Bytes of everything: an [`Agent`] and its memory.
    pub const fn bytes(&self) -> usize {
        size_of::<Agent<'_>>()
            + self.readings * (size_of::<Beam>() + self.waiting * size_of::<u16>())
            + self.scratch() * size_of::<RowSighting>()
            + self.tile_bytes()
    }
}

// The same on every machine of 32 bits.
#[cfg(target_pointer_width = "32")]
const _: () = {
    let default = Bounds::DEFAULT;
    assert!(default.bytes() <= 62 * 1024);
    assert!(default.bytes() - default.tile_bytes() <= 12 * 1024);
    assert!(Bounds::SMALL.bytes() <= 18 * 1024);
    assert!(size_of::<OwnTile>() <= 768);
    assert!(size_of::<FusedTile>() <= 400);
};
