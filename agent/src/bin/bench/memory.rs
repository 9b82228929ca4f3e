//! Sizes of a robot's memory in bytes, by its bounds: the same on every 32-bit machine.

use cortex_m_semihosting::hprintln;
use ubimap_agent::{Bounds, LINK_STATE, Robot, map::OwnTile, share::FusedTile};

/// Prints this file's lines of the table.
pub(crate) fn run() {
    for (name, bounds) in [("default bounds", Bounds::DEFAULT), ("small bounds", Bounds::SMALL)] {
        let (all, tiles) = (size_of::<Robot<'_>>() + bounds.memory_bytes(), bounds.tile_bytes());
        hprintln!("{:>12}  bytes of a robot, {}", all, name);
        hprintln!("{:>12}  bytes of it that are not tiles, {}", all - tiles, name);
    }
    hprintln!("{:>12}  bytes of a tile of its own", size_of::<OwnTile>());
    hprintln!("{:>12}  bytes of a fused tile with coverage", size_of::<FusedTile>());
    hprintln!("{:>12}  bytes of link state", LINK_STATE);
}
