//! Bit maps of the pixels in an image that differ from their background, 64 pixels to a word.

use super::background::Background;

/// Number of pixels compared at a time.
const BLOCK: usize = 2_048;
/// Number of pixels in a word.
pub(super) const WORD: usize = u64::BITS as usize;
/// Code of a pixel whose depth is outside its window.
const DIFFERS: u8 = 1;
/// Code of a pixel whose depth is in front of its window.
const NEARER: u8 = 2;

/// The pixels of an image that are nearer or farther than their background. An empty row precedes the
/// first row and follows the last.
#[derive(Debug)]
pub(super) struct Changes {
    nearer: Vec<u64>,
    farther: Vec<u64>,
    width: usize,
    /// Number of words in an empty row.
    margin: usize,
}

/// 64 consecutive pixels, the first in the lowest bit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Word {
    /// Pixels nearer than their background.
    pub(super) nearer: u64,
    /// Pixels farther than their background.
    pub(super) farther: u64,
    /// Differing pixels with a horizontal and a vertical neighbour on the same side. Others are isolated:
    /// noise, or mixed pixels at an edge.
    pub(super) backed: u64,
}

impl Changes {
    /// Compares the depths of an image `width` pixels wide with the background. Pixels outside
    /// their window that are neither nearer nor farther have no measurement or no background; they
    /// are passed to `blank`, block by block.
    pub(super) fn of(
        background: &Background,
        depths: &[u16],
        width: usize,
        mut blank: impl FnMut(&[usize]),
    ) -> Self {
        let margin = width.div_ceil(WORD);
        // Whole blocks, plus one word for the last unaligned access.
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
            // The last block may be shorter, so the rest of the previous block's codes is cleared.
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

    /// Iterates over the words.
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

/// The positions of the set bits in a word.
pub(super) fn ones(mut word: u64) -> impl Iterator<Item = usize> {
    core::iter::from_fn(move || {
        let at = (word > 0).then(|| word.trailing_zeros() as usize)?;
        word &= word - 1;
        Some(at)
    })
}

/// The 64 bits that start at bit `bit`.
fn from(map: &[u64], bit: usize) -> u64 {
    let (word, shift) = (bit / WORD, bit % WORD);
    map[word] >> shift | map[word + 1] << 1 << (WORD - 1 - shift)
}

/// Compares depths with their windows. A separate function without branches, so that it is vectorised.
#[inline(never)]
fn compare(depths: &[u16], low: &[u16], span: &[u16], codes: &mut [u8; BLOCK]) {
    for (((&depth, &low), &span), code) in depths.iter().zip(low).zip(span).zip(codes) {
        let differs = depth.wrapping_sub(low) > span;
        let is_nearer = differs & (depth < low) & (depth > 0);
        *code = (u8::from(differs) * DIFFERS) | (u8::from(is_nearer) * NEARER);
    }
}

/// A bit mask of the codes that contain `what`.
fn pack(codes: &[u8; WORD], what: u8) -> u64 {
    let mut packed = [0; WORD / 8];
    for (byte, codes) in packed.iter_mut().zip(codes.as_chunks().0) {
        let ones = u64::from_le_bytes(*codes) >> what.trailing_zeros() & 0x0101_0101_0101_0101;
        // The multiplication gathers the lowest bits of eight bytes in the highest byte.
        *byte = (ones.wrapping_mul(0x0102_0408_1020_4080) >> 56) as u8;
    }
    u64::from_le_bytes(packed)
}
