//! An adaptive binary range coder: 32 bits of range, probabilities of 12 bits, integers only.
//!
//! The encoder leaves out the first byte (always zero) and the zero bytes at the end; the decoder
//! reads zeros past the end of its input, so any input decodes to something and reading ends when
//! the caller has what it asked for. Only a number of more than 32 bits is refused.

const TOP: u32 = 1 << 24;
/// How fast a probability follows what is coded: each decision moves it by 1/32 of the way.
const RATE: u32 = 5;

/// The probability that the next decision of one context is 0, in 1/65,536.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Model(pub(super) u16);

impl Model {
    fn split(self, range: u32) -> u32 {
        // Never 0 and never `range`: `update` keeps the probability in 31..=65505.
        (range >> 12) * u32::from((self.0 >> 4).max(1))
    }

    fn update(&mut self, bit: bool) {
        let p = u32::from(self.0);
        let moved = if bit { p - (p >> RATE) } else { p + ((65_536 - p) >> RATE) };
        self.0 = moved as u16;
    }
}

/// The number of plain bits that carry `value` in an Exp-Golomb code of order `order`.
fn golomb_bits(value: u32, order: u32) -> u32 {
    ((u64::from(value) >> order) + 1).ilog2()
}

/// Small signed numbers onto small unsigned ones: 0, -1, 1, -2, ...
fn zigzag(value: i32) -> u32 {
    ((value << 1) ^ (value >> 31)) as u32
}

fn unzigzag(value: u32) -> i32 {
    (value >> 1) as i32 ^ -((value & 1) as i32)
}

/// Writes decisions into a buffer of the caller's. What no longer fits is counted, not written:
/// ask [`Encoder::fits`] before the end.
#[derive(Debug)]
pub(super) struct Encoder<'a> {
    out: &'a mut [u8],
    state: State,
}

/// All of an encoder but its buffer: with it an encoder goes back to an earlier point.
#[derive(Clone, Copy, Debug)]
pub(super) struct State {
    low: u64,
    range: u32,
    /// The last byte that a carry could still change, and how many 0xFF follow it.
    cache: u8,
    pending: u32,
    /// Bytes so far, the first (left out) one included.
    len: usize,
}

impl<'a> Encoder<'a> {
    /// Bytes that [`Encoder::finish`] may still write.
    const TAIL: usize = 4;

    /// Writes into this buffer from its start.
    pub(super) fn new(out: &'a mut [u8]) -> Self {
        Self { out, state: State { low: 0, range: u32::MAX, cache: 0, pending: 1, len: 0 } }
    }

    /// Where the encoder stands, for [`Encoder::rewind`].
    pub(super) fn state(&self) -> State {
        self.state
    }

    /// Goes back to where it stood.
    pub(super) fn rewind(&mut self, state: State) {
        self.state = state;
    }

    /// Whether everything so far fits the buffer, whatever comes out at the end.
    pub(super) fn fits(&self) -> bool {
        self.state.len + self.state.pending as usize + Self::TAIL <= self.out.len() + 1
    }

    /// Codes one decision with a model, and teaches it.
    pub(super) fn bit(&mut self, model: &mut Model, bit: bool) {
        let split = model.split(self.state.range);
        self.narrow(split, bit);
        model.update(bit);
    }

    /// Codes the lowest `count` bits of a value, highest first, as they are.
    pub(super) fn plain(&mut self, value: u32, count: u32) {
        for shift in (0..count).rev() {
            self.narrow(self.state.range >> 1, value >> shift & 1 != 0);
        }
    }

    /// Codes a number in an Exp-Golomb code: short for small ones.
    pub(super) fn golomb(&mut self, value: u32, order: u32) {
        let bits = golomb_bits(value, order);
        self.plain(u32::MAX, bits);
        self.plain(0, 1);
        let rest = u64::from(value) + (1 << order) - (1 << (bits + order));
        self.plain(rest as u32, bits + order);
    }

    /// Codes a signed number in an Exp-Golomb code.
    pub(super) fn signed(&mut self, value: i32, order: u32) {
        self.golomb(zigzag(value), order);
    }

    /// Ends the stream. Returns its length, or `None` if it did not fit.
    pub(super) fn finish(mut self) -> Option<usize> {
        // Of all numbers in the final interval, the one with the most zero bytes at its end.
        let low = self.state.low;
        let high = low + u64::from(self.state.range) - 1;
        let zeros = [24, 16, 8].into_iter().find(|zeros| high >> zeros << zeros >= low);
        self.state.low = high >> zeros.unwrap_or(0) << zeros.unwrap_or(0);
        for _ in 0..5 {
            self.shift();
        }
        let len = self.state.len.checked_sub(1)?;
        let written = self.out.get(..len);
        // Zeros that did not fit do not matter either: they are left out.
        let written = written.unwrap_or(self.out);
        let used = written.iter().rposition(|&byte| byte != 0).map_or(0, |last| last + 1);
        Some(used)
    }

    fn narrow(&mut self, split: u32, bit: bool) {
        let state = &mut self.state;
        if bit {
            state.low += u64::from(split);
            state.range -= split;
        } else {
            state.range = split;
        }
        while self.state.range < TOP {
            self.state.range <<= 8;
            self.shift();
        }
    }

    fn shift(&mut self) {
        let carry = (self.state.low >> 32) as u8;
        if self.state.low < 0xFF00_0000 || carry != 0 {
            let mut byte = self.state.cache.wrapping_add(carry);
            for _ in 0..self.state.pending {
                // The very first byte is zero and left out.
                if let Some(index) = self.state.len.checked_sub(1)
                    && let Some(slot) = self.out.get_mut(index)
                {
                    *slot = byte;
                }
                self.state.len += 1;
                byte = 0xFFu8.wrapping_add(carry);
            }
            self.state.pending = 0;
            self.state.cache = (self.state.low >> 24) as u8;
        }
        self.state.pending += 1;
        self.state.low = (self.state.low & 0x00FF_FFFF) << 8;
    }
}

/// Reads decisions. Any input gives some: it never runs on by itself.
#[derive(Debug)]
pub(super) struct Decoder<'a> {
    input: &'a [u8],
    /// Bytes read, those past the end included.
    read: usize,
    code: u32,
    range: u32,
}

impl<'a> Decoder<'a> {
    /// Reads what an [`Encoder`] wrote.
    pub(super) fn new(input: &'a [u8]) -> Self {
        let mut decoder = Self { input, read: 0, code: 0, range: u32::MAX };
        for _ in 0..4 {
            decoder.pull();
        }
        decoder
    }

    /// Whether the whole input has been read and hardly more: an input of another length was
    /// not written by an encoder.
    pub(super) fn is_exhausted(&self) -> bool {
        self.read >= self.input.len()
    }

    /// Reads one decision with a model, and teaches it.
    pub(super) fn bit(&mut self, model: &mut Model) -> bool {
        let split = model.split(self.range);
        let bit = self.widen(split);
        model.update(bit);
        bit
    }

    /// Reads `count` bits, at most 32, as they are.
    pub(super) fn plain(&mut self, count: u32) -> u32 {
        let mut value = 0;
        for _ in 0..count {
            value = value << 1 | u32::from(self.widen(self.range >> 1));
        }
        value
    }

    /// Reads a number in an Exp-Golomb code; `None` for one of more than 32 bits, which no encoder
    /// writes.
    pub(super) fn golomb(&mut self, order: u32) -> Option<u32> {
        let mut bits = order;
        while self.plain(1) == 1 {
            bits += 1;
            if bits > 32 {
                return None;
            }
        }
        let rest = self.plain(bits);
        u32::try_from((1u64 << bits) - (1 << order) + u64::from(rest)).ok()
    }

    /// Reads a signed number in an Exp-Golomb code; `None` as for [`Decoder::golomb`].
    pub(super) fn signed(&mut self, order: u32) -> Option<i32> {
        Some(unzigzag(self.golomb(order)?))
    }

    fn widen(&mut self, split: u32) -> bool {
        let bit = self.code >= split;
        if bit {
            self.code -= split;
            self.range -= split;
        } else {
            self.range = split;
        }
        while self.range < TOP {
            self.range <<= 8;
            self.pull();
        }
        bit
    }

    fn pull(&mut self) {
        let byte = self.input.get(self.read).copied().unwrap_or(0);
        self.read = self.read.saturating_add(1);
        self.code = self.code << 8 | u32::from(byte);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[derive(Clone, Debug)]
    enum Step {
        Bit(usize, bool),
        Plain(u32, u32),
        Golomb(u32, u32),
        Signed(i32, u32),
    }

    fn steps() -> impl Strategy<Value = std::vec::Vec<Step>> {
        let skewed = (0usize..4, prop::bool::weighted(0.03)).prop_map(|(m, b)| Step::Bit(m, b));
        let step = prop_oneof![
            8 => skewed,
            2 => (0usize..4, any::<bool>()).prop_map(|(m, b)| Step::Bit(m, b)),
            1 => (any::<u32>(), 0u32..=32).prop_map(|(v, n)| Step::Plain(v, n)),
            1 => (0u32..100_000, 0u32..6).prop_map(|(v, k)| Step::Golomb(v, k)),
            1 => (any::<u32>(), 0u32..6).prop_map(|(v, k)| Step::Golomb(v, k)),
            1 => (any::<u32>(), 0u32..6).prop_map(|(v, k)| Step::Golomb(u32::MAX - v % 40, k)),
            1 => (-40_000i32..40_000, 0u32..6).prop_map(|(v, k)| Step::Signed(v, k)),
            1 => (any::<i32>(), 0u32..6).prop_map(|(v, k)| Step::Signed(v, k)),
        ];
        proptest::collection::vec(step, 0..400)
    }

    proptest! {
        #[test]
        fn decisions_read_back(steps in steps()) {
            let mut out = [0u8; 4096];
            let mut encoder = Encoder::new(&mut out);
            let mut models = [Model(32_768); 4];
            for step in &steps {
                match *step {
                    Step::Bit(model, bit) => encoder.bit(&mut models[model], bit),
                    Step::Plain(value, count) => encoder.plain(value, count),
                    Step::Golomb(value, order) => encoder.golomb(value, order),
                    Step::Signed(value, order) => encoder.signed(value, order),
                }
            }
            prop_assert!(encoder.fits());
            let len = encoder.finish().unwrap();
            let mut decoder = Decoder::new(&out[..len]);
            let mut models = [Model(32_768); 4];
            for step in &steps {
                match *step {
                    Step::Bit(model, bit) => prop_assert_eq!(decoder.bit(&mut models[model]), bit),
                    Step::Plain(value, count) => {
                        let mask = (1u64 << count) - 1;
                        prop_assert_eq!(u64::from(decoder.plain(count)), u64::from(value) & mask);
                    }
                    Step::Golomb(value, order) => {
                        prop_assert_eq!(decoder.golomb(order), Some(value));
                    }
                    Step::Signed(value, order) => {
                        prop_assert_eq!(decoder.signed(order), Some(value));
                    }
                }
            }
            prop_assert!(decoder.is_exhausted());
        }

        #[test]
        fn what_fits_is_whole(steps in steps(), room in 0usize..200) {
            let mut out = [0u8; 4096];
            let mut small = [0u8; 200];
            let mut wide = Encoder::new(&mut out);
            let mut tight = Encoder::new(&mut small[..room]);
            let mut models = [Model(32_768); 4];
            for step in &steps {
                if let Step::Bit(model, bit) = *step {
                    let mut same = models[model];
                    wide.bit(&mut same, bit);
                    tight.bit(&mut models[model], bit);
                }
            }
            let fits = tight.fits();
            let (wide_len, tight_len) = (wide.finish().unwrap(), tight.finish().unwrap());
            if fits {
                prop_assert_eq!(&out[..wide_len], &small[..tight_len]);
            }
        }
    }

    #[test]
    fn a_number_of_more_than_32_bits_is_none() {
        let ones = [0xFF; 40];
        assert_eq!(Decoder::new(&ones).golomb(4), None);
        let mut out = [0u8; 40];
        let mut encoder = Encoder::new(&mut out);
        // 2^32 in order 3: 29 ones, a zero, and the remainder 8 of 32 bits.
        encoder.plain(u32::MAX, 29);
        encoder.plain(0, 1);
        encoder.plain(8, 32);
        let len = encoder.finish().unwrap();
        assert_eq!(Decoder::new(&out[..len]).golomb(3), None);
    }

    #[test]
    fn a_lopsided_stream_is_short() {
        let mut out = [0u8; 600];
        let mut encoder = Encoder::new(&mut out);
        let mut model = Model(32_768);
        for _ in 0..4096 {
            encoder.bit(&mut model, false);
        }
        let len = encoder.finish().unwrap();
        assert!(len <= 8, "{len}");
    }
}
