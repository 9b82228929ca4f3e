//! A robot's placement as bytes, little-endian. Of each correction its second, x, y (mm) and heading (binary angle); of
//! each tile with ground its x and y, and the words of its rows.

use ubimap_protocol::{
    tile::{TILE_SIDE, TileId},
    units::{Angle, Millimetres, Pose},
};

use crate::mapping::{Correction, Placement};

/// Bytes of a correction, and of a tile.
const LEN: usize = 14;
const TILE_LEN: usize = 4 + 4 * TILE_SIDE;

/// The corrections and the ground.
pub(super) fn bytes(placement: &Placement) -> [Vec<u8>; 2] {
    let mut corrections = Vec::with_capacity(LEN * placement.corrections.len());
    for &Correction { since, by: Pose { x, y, heading } } in &placement.corrections {
        corrections.extend(since.to_le_bytes());
        corrections.extend(x.0.to_le_bytes());
        corrections.extend(y.0.to_le_bytes());
        corrections.extend(heading.0.to_le_bytes());
    }
    let mut ground = Vec::with_capacity(TILE_LEN * placement.ground.len());
    for (&TileId { x, y }, rows) in &placement.ground {
        ground.extend(x.to_le_bytes());
        ground.extend(y.to_le_bytes());
        ground.extend(rows.iter().flat_map(|row| row.to_le_bytes()));
    }
    [corrections, ground]
}

/// The inverse of [`bytes`]; the row's checksum says that they are whole.
pub(super) fn read(corrections: &[u8], ground: &[u8]) -> Placement {
    let correction = |it: &[u8; LEN]| {
        let [s0, s1, s2, s3, x0, x1, x2, x3, y0, y1, y2, y3, h0, h1] = *it;
        let x = Millimetres(i32::from_le_bytes([x0, x1, x2, x3]));
        let y = Millimetres(i32::from_le_bytes([y0, y1, y2, y3]));
        let heading = Angle(u16::from_le_bytes([h0, h1]));
        Correction { since: u32::from_le_bytes([s0, s1, s2, s3]), by: Pose { x, y, heading } }
    };
    let tile = |it: &[u8; TILE_LEN]| {
        let [x0, x1, y0, y1, ref words @ ..] = *it;
        let id = TileId { x: i16::from_le_bytes([x0, x1]), y: i16::from_le_bytes([y0, y1]) };
        let mut rows = [0; TILE_SIDE];
        let words = words.as_chunks().0.iter().map(|word| u32::from_le_bytes(*word));
        rows.iter_mut().zip(words).for_each(|(row, word)| *row = word);
        (id, rows)
    };
    Placement {
        corrections: corrections.as_chunks::<LEN>().0.iter().map(correction).collect(),
        ground: ground.as_chunks::<TILE_LEN>().0.iter().map(tile).collect(),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn what_is_written_is_read(
            corrections in proptest::collection::vec(any::<(u32, i32, i32, u16)>(), 0..9),
            ground in proptest::collection::btree_map(any::<(i16, i16)>(), any::<[u32; TILE_SIDE]>(), 0..4),
        ) {
            let correction = |(since, x, y, heading)| {
                let (x, y, heading) = (Millimetres(x), Millimetres(y), Angle(heading));
                Correction { since, by: Pose { x, y, heading } }
            };
            let placement = Placement {
                corrections: corrections.into_iter().map(correction).collect(),
                ground: ground.into_iter().map(|((x, y), rows)| (TileId { x, y }, rows)).collect(),
            };
            let [corrections, ground] = bytes(&placement);
            prop_assert_eq!(read(&corrections, &ground), placement);
        }
    }
}
