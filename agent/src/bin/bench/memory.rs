//! Bytes of memory that an agent takes, by its bounds: the same on every 32-bit machine.

use cortex_m_semihosting::hprintln;
use ubimap_agent::{
    Agent, LINK_STATE,
    map::{OwnTile, RowSighting, scratch_words},
    sense::Beam,
    share::FusedTile,
};

use crate::{MAX_RANGE, RESOLUTION};

/// Readings of a scan, scans that may wait, tiles of its own and fused, and the range.
struct Bounds {
    readings: usize,
    waiting: usize,
    own: usize,
    fused: usize,
    range: u16,
}

/// The lines of this file's table.
pub(crate) fn run() {
    let default = Bounds { readings: 640, waiting: 2, own: 32, fused: 64, range: MAX_RANGE };
    let small = Bounds { readings: 64, waiting: 2, own: 8, fused: 12, range: MAX_RANGE / 2 };
    for (name, bounds) in [("default bounds", default), ("small bounds", small)] {
        let tiles = bounds.own * size_of::<OwnTile>() + bounds.fused * size_of::<FusedTile>();
        let scan = bounds.readings * size_of::<Beam>() + bounds.readings * bounds.waiting * 2;
        let scratch = scratch_words(bounds.range, RESOLUTION) * size_of::<RowSighting>();
        let rest = size_of::<Agent<'_>>() + scan + scratch;
        hprintln!("{:>12}  bytes of an agent, {}", tiles + rest, name);
        hprintln!("{:>12}  bytes of it that are not tiles, {}", rest, name);
    }
    hprintln!("{:>12}  bytes of a tile of its own", size_of::<OwnTile>());
    hprintln!("{:>12}  bytes of a fused tile with coverage", size_of::<FusedTile>());
    hprintln!("{:>12}  bytes of link state", LINK_STATE);
}
