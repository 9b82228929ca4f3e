//! Hashes by which two sides check whether they hold the same tiles.

use super::{Stamp, TILE_SIDE, Tile, TileId};
use crate::checksum::crc32;

/// The hash of a tile's cells: the CRC-32 of the rows of its low plane, then of its high plane,
/// each row a little-endian word.
pub fn tile_hash(tile: &Tile) -> u32 {
    let mut bytes = [0u8; 8 * TILE_SIDE];
    for (bytes, word) in bytes.chunks_exact_mut(4).zip(tile.low.iter().chain(&tile.high)) {
        bytes.copy_from_slice(&word.to_le_bytes());
    }
    crc32(&[&bytes])
}

/// A checksum of 16 bits over the base cells that an update builds upon. It is needed because two
/// sides may hold different cells under one stamp (SPEC 8.3). Some 200 instructions for each base
/// on a Cortex-M4.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct BaseCheck(Option<u32>);

impl BaseCheck {
    /// Adds the cells of a base.
    #[inline(never)]
    pub(super) fn add(&mut self, base: &Tile) {
        let mut sum = self.0.unwrap_or(0);
        for plane in [&base.low, &base.high] {
            for row in plane {
                sum = (sum.rotate_left(5) ^ row).wrapping_mul(0x9E37_79B9);
            }
        }
        self.0 = Some(sum);
    }

    /// The checksum; `None` if no base was added.
    pub(super) fn value(self) -> Option<u32> {
        self.0.map(|sum| sum >> 16)
    }
}

/// The digest of a set of tiles, independent of their order: the wrapping sum of the CRC-32 of each
/// tile's id, epoch, version and hash, all little-endian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Digest(pub u64);

impl Digest {
    /// Adds a tile.
    pub fn add(&mut self, id: TileId, stamp: Stamp, hash: u32) {
        let crc = crc32(&[
            &id.x.to_le_bytes(),
            &id.y.to_le_bytes(),
            &stamp.epoch.0.to_le_bytes(),
            &stamp.version.0.to_le_bytes(),
            &hash.to_le_bytes(),
        ]);
        self.0 = self.0.wrapping_add(u64::from(crc));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tile::{Cell, Epoch, Version};

    #[test]
    fn a_digest_depends_on_each_field_but_not_on_the_order_of_tiles() {
        let stamp = Stamp { epoch: Epoch(1), version: Version(2) };
        let (here, there) = (TileId { x: 1, y: 2 }, TileId { x: 2, y: 1 });
        let digest = |entries: &[(TileId, Stamp, u32)]| {
            let mut digest = Digest::default();
            entries.iter().for_each(|&(id, stamp, hash)| digest.add(id, stamp, hash));
            digest
        };
        assert_eq!(
            digest(&[(here, stamp, 3), (there, stamp, 4)]),
            digest(&[(there, stamp, 4), (here, stamp, 3)])
        );
        let newer = Stamp { version: Version(3), ..stamp };
        assert_ne!(digest(&[(here, stamp, 3)]), digest(&[(here, newer, 3)]));
        assert_ne!(digest(&[(here, stamp, 3)]), digest(&[(there, stamp, 3)]));
    }

    #[test]
    fn one_cell_changes_the_hash() {
        let mut tile = Tile::UNKNOWN;
        let empty = tile_hash(&tile);
        tile.set(31, 31, Cell::Movable);
        assert_ne!(tile_hash(&tile), empty);
    }
}
