//! The sizes of a robot's memory.

use ubimap_protocol::units::Millimetres;

use crate::{
    map::{OwnTile, RowSighting, scratch_words},
    sense::Beam,
    share::FusedTile,
};

/// The sizes of a robot's memory. A [`Config`](crate::Config) and its [`Memory`](crate::Memory) are
/// built from the same bounds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bounds {
    /// Readings per scan.
    pub readings: usize,
    /// Scans that can wait for their poses at the same time, 1 to 8.
    pub waiting: usize,
    /// Tiles in the pool of the robot's own layer. A scan with 4 m of range touches at most 21
    /// tiles of 5 cm cells.
    pub own_tiles: usize,
    /// Tiles of the server's map that the robot holds: the largest square of tiles around the robot
    /// that fits into this number.
    pub fused_tiles: usize,
    /// The maximum mapped range, in millimetres.
    pub max_range: u16,
    /// The side of a map cell; must equal the server's.
    pub resolution: Millimetres,
}

impl Bounds {
    /// A depth camera's row of 640 pixels, 4 m of range: 62 kB.
    pub const DEFAULT: Self = Self {
        readings: 640,
        waiting: 2,
        own_tiles: 32,
        fused_tiles: 64,
        max_range: 4_000,
        resolution: Millimetres(50),
    };

    /// The bounds of the reference board's firmware: a row of 100 pixels, a window of 4 x 4 tiles,
    /// and the maximum range for which eight own tiles suffice.
    pub const REFERENCE: Self =
        Self { readings: 100, own_tiles: 8, fused_tiles: 16, max_range: 2_000, ..Self::DEFAULT };

    /// A row of 64 pixels, for a Cortex-M0+: 17 kB.
    pub const SMALL: Self =
        Self { readings: 64, own_tiles: 8, fused_tiles: 12, max_range: 2_000, ..Self::DEFAULT };

    /// Number of words of scratch memory for mapping.
    pub const fn scratch(&self) -> usize {
        scratch_words(self.max_range, self.resolution)
    }

    /// Size of both pools of tiles, in bytes.
    pub const fn tile_bytes(&self) -> usize {
        self.own_tiles * size_of::<OwnTile>() + self.fused_tiles * size_of::<FusedTile>()
    }

    /// Size of the [`Memory`](crate::Memory) of a robot without a drive, in bytes.
    pub const fn memory_bytes(&self) -> usize {
        self.readings * (size_of::<Beam>() + self.waiting * size_of::<u16>())
            + self.scratch() * size_of::<RowSighting>()
            + self.tile_bytes()
    }
}

// These sizes are the same on every 32-bit machine.
#[cfg(target_pointer_width = "32")]
const _: () = {
    assert!(size_of::<OwnTile>() <= 768);
    assert!(size_of::<FusedTile>() <= 400);
};
