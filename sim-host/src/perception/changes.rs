//! Which pixels of an image see something else than their background, 64 to a word.

use super::background::Background;

/// Pixels that are compared before their words are made, and those in a word.
const BLOCK: usize = 2_048;
pub(super) const WORD: usize = u64::BITS as usize;
/// What comparing says of a pixel: it is out of its window, and nearer than that.
const DIFFERS: u8 = 1;
const NEARER: u8 = 2;

/// The pixels of an image that are nearer or farther than their background. In front of the first
/// and behind the last there is an empty row.
#[derive(Debug)]
pub(super) struct Changes {
    nearer: Vec<u64>,
    farther: Vec<u64>,
    width: usize,
    /// The words of an empty row.
    margin: usize,
}

/// The pixels of a word, the first in the lowest bit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Word {
    /// Those that are nearer than their background.
    pub(super) nearer: u64,
    /// Those that are farther.
    pub(super) farther: u64,
    /// Those of both whose neighbours, one in the row and one in the column, are on the same side: a
    /// pixel that stands out alone is noise, or mixed at an edge.
    pub(super) backed: u64,
}

impl Changes {
    /// Of the depths of an image, in rows of so many. `blank` takes the pixels that do not agree with
    /// their background and are on no side of it, as many at a time as there are in a block: they did
    /// not measure, or have none.
    pub(super) fn of(
        background: &Background,
        depths: &[u16],
        width: usize,
        mut blank: impl FnMut(&[usize]),
    ) -> Self {
        let margin = width.div_ceil(WORD);
        // Whole blocks, and one for the last unaligned word.
        let words = depths.len().next_multiple_of(BLOCK) / WORD + 2 * margin + 1;
        let map = || {
            let mut map = Vec::with_capacity(words);
            map.resize(margin, 0);
            map
        };
        let mut changes = Self { nearer: map(), farther: map(), width, margin };
        let (low, span) = background.windows();
        let (mut codes, mut pixels) = ([0; BLOCK], [0; BLOCK]);
        let blocks = depths.chunks(BLOCK).zip(low.chunks(BLOCK)).zip(span.chunks(BLOCK));
        for (block, ((depths, low), span)) in (0..).step_by(BLOCK).zip(blocks) {
            // Of the last block, which may be shorter, nothing old may be left.
            codes[depths.len()..].fill(0);
            compare(depths, low, span, &mut codes);
            let mut count = 0;
            for (first, codes) in (0..).step_by(WORD).zip(codes.as_chunks().0) {
                let differs = pack(codes, DIFFERS);
                let nearer = if differs > 0 { pack(codes, NEARER) } else { 0 };
                let mut farther = 0;
                for at in ones(differs & !nearer) {
                    let (depth, low) = (depths[first + at], low[first + at]);
                    let is_farther = depth >= low && low > 0;
                    farther |= u64::from(is_farther) << at;
                    pixels[count] = block + first + at;
                    count += usize::from(!is_farther);
                }
                changes.nearer.push(nearer);
                changes.farther.push(farther);
            }
            blank(&pixels[..count]);
        }
        for map in [&mut changes.nearer, &mut changes.farther] {
            map.resize(words, 0);
        }
        changes
    }

    /// Word by word.
    pub(super) fn words(&self) -> impl Iterator<Item = Word> {
        (self.margin..self.nearer.len() - self.margin - 1).map(|at| Word {
            nearer: self.nearer[at],
            farther: self.farther[at],
            backed: self.backed(&self.nearer, at) | self.backed(&self.farther, at),
        })
    }

    fn backed(&self, map: &[u64], word: usize) -> u64 {
        if map[word] == 0 {
            return 0;
        }
        let either = |step: usize| from(map, word * WORD - step) | from(map, word * WORD + step);
        map[word] & either(1) & either(self.width)
    }
}

/// The places of the ones in a word.
pub(super) fn ones(mut word: u64) -> impl Iterator<Item = usize> {
    core::iter::from_fn(move || {
        let at = (word > 0).then(|| word.trailing_zeros() as usize)?;
        word &= word - 1;
        Some(at)
    })
}

/// 64 bits from one on.
fn from(map: &[u64], bit: usize) -> u64 {
    let (word, shift) = (bit / WORD, bit % WORD);
    map[word] >> shift | map[word + 1] << 1 << (WORD - 1 - shift)
}

/// Compares depths with their windows. Kept by itself and without a branch, so that it is compiled to
/// vectors.
#[inline(never)]
fn compare(depths: &[u16], low: &[u16], span: &[u16], codes: &mut [u8; BLOCK]) {
    for (((&depth, &low), &span), code) in depths.iter().zip(low).zip(span).zip(codes) {
        let differs = depth.wrapping_sub(low) > span;
        let is_nearer = differs & (depth < low) & (depth > 0);
        *code = (u8::from(differs) * DIFFERS) | (u8::from(is_nearer) * NEARER);
    }
}

/// Which of the codes say this.
fn pack(codes: &[u8; WORD], what: u8) -> u64 {
    let mut packed = [0; WORD / 8];
    for (byte, codes) in packed.iter_mut().zip(codes.as_chunks().0) {
        let ones = u64::from_le_bytes(*codes) >> what.trailing_zeros() & 0x0101_0101_0101_0101;
        // The product brings the lowest bits of eight bytes together in the highest byte.
        *byte = (ones.wrapping_mul(0x0102_0408_1020_4080) >> 56) as u8;
    }
    u64::from_le_bytes(packed)
}
