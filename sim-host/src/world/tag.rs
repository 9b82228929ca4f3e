//! The patterns of the AprilTag family 36h11 (Olson 2011; Wang and Olson 2016).
//!
//! A tag is a black square, eight modules wide, whose inner 6 x 6 modules encode its number, surrounded
//! by a white margin of one module.

/// Side of the black square in modules.
pub const SQUARE: usize = 8;

/// Side including the margin in modules.
pub const SIDE: usize = SQUARE + 2;

/// Number of tags of the family that are available here.
pub const TAGS: usize = CODES.len();

/// The codes of the first tags of the family; the most significant bit is the first of [`place`].
const CODES: [u64; 64] = [
    0xd_7e00_984b,
    0xd_da66_4ca7,
    0xd_c4a1_c821,
    0xe_17b4_70e9,
    0xe_f91d_01b1,
    0xf_429c_dd73,
    0x0_5da2_9225,
    0x1_106c_ba43,
    0x2_23be_d79d,
    0x2_1f51_213c,
    0x3_3eb1_9ca6,
    0x3_f76e_b0f8,
    0x4_69a9_7414,
    0x4_5dcf_e0b0,
    0x4_a646_5f72,
    0x5_1801_db96,
    0x5_eb94_6b4e,
    0x6_8a7c_c2ec,
    0x6_f0ba_2652,
    0x7_8765_559d,
    0x8_7b83_d129,
    0x8_6cc4_a5c5,
    0x8_b64d_f90f,
    0x9_c577_b611,
    0xa_3810_f2f5,
    0xa_f4d7_5b83,
    0xb_59a0_3fef,
    0xb_b109_6f85,
    0xd_1b92_fc76,
    0xd_0dd5_09d2,
    0xe_2cfd_a160,
    0x2_ff49_7c63,
    0x4_7240_671b,
    0x5_047a_2e55,
    0x6_35ca_87c7,
    0x6_9125_4166,
    0x6_8f43_d94a,
    0x6_ef24_bdb6,
    0x8_cdd8_f886,
    0x9_de96_b718,
    0xa_ff6e_5a8a,
    0xb_ae46_f029,
    0xd_225b_6d59,
    0xd_f8ba_8c01,
    0xe_3744_a22f,
    0xf_bb59_375d,
    0x1_8a91_6828,
    0x2_2f29_c1ba,
    0x2_8688_7d58,
    0x4_1392_322e,
    0x7_5d18_ecd1,
    0x8_7c30_2743,
    0x8_c631_7ba9,
    0x9_e40f_36d7,
    0xc_0e5a_806a,
    0xc_c78c_b87c,
    0x1_2d2f_2d01,
    0x3_79f3_6a21,
    0x6_973f_59ac,
    0x7_789e_a9f4,
    0x8_f1c7_3e84,
    0x8_dd28_7a20,
    0x9_4a4e_ee4c,
    0xa_4553_79b5,
];

/// Which modules of a tag are white: rows from the top, each from the left, including the margin. `None` for
/// a number that is not available here. The upper edge is the front of the robot that wears the tag.
pub fn pattern(id: usize) -> Option<[[bool; SIDE]; SIDE]> {
    let code = CODES.get(id)?;
    let mut white = [[true; SIDE]; SIDE];
    for row in &mut white[1..SIDE - 1] {
        row[1..SIDE - 1].fill(false);
    }
    for bit in 0..36 {
        let (column, row) = place(bit);
        white[row + 1][column + 1] = code >> (35 - bit) & 1 == 1;
    }
    Some(white)
}

/// The column and row of a bit within the black square: nine bits in the upper left quarter of the inner
/// square, then the same rotated clockwise by one, two and three quarters.
fn place(bit: usize) -> (usize, usize) {
    const CORNER: [(usize, usize); 9] =
        [(1, 1), (2, 1), (3, 1), (4, 1), (5, 1), (2, 2), (3, 2), (4, 2), (3, 3)];
    (0..bit / 9).fold(CORNER[bit % 9], |(column, row), _| (SQUARE - 1 - row, column))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Any two tags differ in at least eleven modules in any rotation. The family guarantees this, and a
    /// mistyped code would violate it.
    #[test]
    fn any_two_tags_differ_in_every_rotation() {
        let word = |id: usize, turns: usize| {
            let white = pattern(id).unwrap();
            let modules = (2..8).flat_map(|row| (2..8).map(move |column| (column, row)));
            modules.fold(0_u64, |word, at| {
                let (column, row) = (0..turns).fold(at, |(c, r), _| (SIDE - 1 - r, c));
                word << 1 | u64::from(white[row][column])
            })
        };
        for id in 0..TAGS {
            for other in 0..=id {
                for turns in usize::from(id == other)..4 {
                    let apart = (word(id, 0) ^ word(other, turns)).count_ones();
                    assert!(apart >= 11, "{id} and {other} turned {turns} times: {apart}");
                }
            }
        }
    }
}
