//! An adaptive binary range coder: 32 bits of range, probabilities of 12 bits, integers only.
//!
//! The encoder omits trailing zero bytes, and the decoder reads zeros past the end of its input. So
//! any input can be decoded, and the caller decides when to stop. Only numbers of more than 32 bits
//! are refused.
//!
//! A decision takes about twenty instructions when it is inlined into a loop over cells that holds
//! the coder by value, so that its state stays in registers.

use core::slice;

const TOP: u32 = 1 << 24;
/// Adaptation rate: each decision moves the probability by 1/32 of the distance to its target.
const RATE: u32 = 5;

/// A context's probability that its next decision is 0, in 1/65,536.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Model(pub(super) u16);

impl Model {
    #[inline(always)]
    fn split(self, range: u32) -> u32 {
        // Below `range` and above 0, because `update` keeps the probability in 31..=65505.
        (range >> 12) * u32::from(self.0 >> 4)
    }

    #[inline(always)]
    fn update(&mut self, bit: bool) {
        // The step `(goal - p) >> RATE` is rounded down, so that p stays in 31..=65505.
        let (p, goal) = (i32::from(self.0), if bit { 31 } else { 65_536 });
        self.0 = (p + ((goal - p) >> RATE)) as u16;
    }
}

/// The number of ones with which the Exp-Golomb code of `value` in order `order` begins. For n
/// ones, a zero and n + `order` further bits follow.
fn golomb_bits(value: u32, order: u32) -> u32 {
    ((u64::from(value) >> order) + 1).ilog2()
}

/// Maps small signed numbers to small unsigned ones: 0, -1, 1, -2 become 0, 1, 2, 3.
fn zigzag(value: i32) -> u32 {
    ((value << 1) ^ (value >> 31)) as u32
}

fn unzigzag(value: u32) -> i32 {
    (value >> 1) as i32 ^ -((value & 1) as i32)
}

/// Writes decisions into the caller's buffer. Bytes beyond its end are counted but not written:
/// check [`Encoder::fits`] before finishing.
#[derive(Debug)]
pub(super) struct Encoder<'a> {
    out: &'a mut [u8],
    state: State,
}

/// The state of an encoder without its buffer.
#[derive(Clone, Copy, Debug)]
pub(super) struct State {
    /// The low end of the interval, after the bytes already written.
    low: u32,
    range: u32,
    /// Bytes written, or counted if they did not fit.
    len: usize,
}

/// A point to which an encoder can rewind.
#[derive(Clone, Copy, Debug)]
pub(super) struct Checkpoint {
    state: State,
    last: Option<u8>,
}

impl<'a> Encoder<'a> {
    /// Maximum number of bytes that one more decision, 16 bits and [`Encoder::finish`] write.
    const TAIL: usize = 6;

    /// Writes to `out` from its start.
    pub(super) fn new(out: &'a mut [u8]) -> Self {
        Self { out, state: State { low: 0, range: u32::MAX, len: 0 } }
    }

    /// A copy on the same buffer, to be held by value; pass its final state to [`Encoder::resume`].
    pub(super) fn by_value(&mut self) -> Encoder<'_> {
        Encoder { out: self.out, state: self.state }
    }

    /// The current state.
    pub(super) fn state(&self) -> State {
        self.state
    }

    /// Continues from the final state of a copy made by [`Encoder::by_value`].
    pub(super) fn resume(&mut self, state: State) {
        self.state = state;
    }

    /// The current position, for [`Encoder::rewind`].
    pub(super) fn checkpoint(&mut self) -> Checkpoint {
        Checkpoint { state: self.state, last: self.written().last().copied() }
    }

    /// Goes back to a checkpoint.
    pub(super) fn rewind(&mut self, to: Checkpoint) {
        self.state = to.state;
        let written = self.written();
        // At most one carry can have reached back past the checkpoint, and it changed the last
        // byte.
        if written.last().copied() != to.last {
            for byte in written.iter_mut().rev() {
                *byte = byte.wrapping_sub(1);
                if *byte != 0xFF {
                    break;
                }
            }
        }
    }

    /// The bytes written; empty if they exceed the buffer.
    fn written(&mut self) -> &mut [u8] {
        self.out.get_mut(..self.state.len).unwrap_or_default()
    }

    /// Whether everything written, the end of the stream and `spare` more bytes fit in the buffer.
    #[inline(always)]
    pub(super) fn fits(&self, spare: usize) -> bool {
        self.state.len + (Self::TAIL + spare) <= self.out.len()
    }

    /// Codes one decision with a model and adapts the model.
    #[inline(never)]
    pub(super) fn bit(&mut self, model: &mut Model, bit: bool) {
        self.bit_inlined(model, bit);
    }

    /// [`Encoder::bit`], inlined for the loop over cells.
    #[inline(always)]
    pub(super) fn bit_inlined(&mut self, model: &mut Model, bit: bool) {
        let split = model.split(self.state.range);
        self.narrow(split, bit);
        model.update(bit);
    }

    /// Codes the lowest `count` bits of a value, highest first, without a model.
    pub(super) fn plain(&mut self, value: u32, count: u32) {
        for shift in (0..count).rev() {
            self.narrow(self.state.range >> 1, value >> shift & 1 != 0);
        }
    }

    /// Codes a number in an Exp-Golomb code, which is short for small numbers.
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

    /// Ends the stream. Returns its length in bytes, or `None` if it did not fit.
    pub(super) fn finish(mut self) -> Option<usize> {
        // The interval is wider than 2^24, so it contains a number with only one non-zero byte.
        self.raise(self.state.range - 1);
        self.state.low &= !(TOP - 1);
        self.shift();
        let written = self.out.get(..self.state.len)?;
        Some(written.iter().rposition(|&byte| byte != 0).map_or(0, |last| last + 1))
    }

    #[inline(always)]
    fn narrow(&mut self, split: u32, bit: bool) {
        if bit {
            self.raise(split);
            self.state.range -= split;
        } else {
            self.state.range = split;
        }
        while self.state.range < TOP {
            self.state.range <<= 8;
            self.shift();
        }
    }

    #[inline(always)]
    fn raise(&mut self, by: u32) {
        let (low, carry) = self.state.low.overflowing_add(by);
        self.state.low = low;
        if carry {
            carry_into(self.written());
        }
    }

    #[inline(always)]
    fn shift(&mut self) {
        if let Some(slot) = self.out.get_mut(self.state.len) {
            *slot = (self.state.low >> 24) as u8;
        }
        self.state.len += 1;
        self.state.low <<= 8;
    }
}

/// Adds one to a big-endian number.
#[cold]
#[inline(never)]
fn carry_into(number: &mut [u8]) {
    for byte in number.iter_mut().rev() {
        *byte = byte.wrapping_add(1);
        if *byte != 0 {
            break;
        }
    }
}

/// Reads decisions. Any input yields decisions, and each call reads exactly one.
#[derive(Clone, Debug)]
pub(super) struct Decoder<'a> {
    rest: slice::Iter<'a, u8>,
    code: u32,
    range: u32,
}

impl<'a> Decoder<'a> {
    /// Reads a stream written by an [`Encoder`].
    pub(super) fn new(input: &'a [u8]) -> Self {
        let mut decoder = Self { rest: input.iter(), code: 0, range: u32::MAX };
        for _ in 0..4 {
            decoder.pull();
        }
        decoder
    }

    /// Whether the whole input has been read. If not, no encoder wrote it.
    pub(super) fn is_exhausted(&self) -> bool {
        self.rest.as_slice().is_empty()
    }

    /// Reads one decision with a model and adapts the model.
    #[inline(never)]
    pub(super) fn bit(&mut self, model: &mut Model) -> bool {
        self.bit_inlined(model)
    }

    /// [`Decoder::bit`], inlined for the loop over cells.
    #[inline(always)]
    pub(super) fn bit_inlined(&mut self, model: &mut Model) -> bool {
        let split = model.split(self.range);
        let bit = self.widen(split);
        model.update(bit);
        bit
    }

    /// Reads `count` bits, at most 32, coded without a model.
    pub(super) fn plain(&mut self, count: u32) -> u32 {
        let mut value = 0;
        for _ in 0..count {
            value = value << 1 | u32::from(self.widen(self.range >> 1));
        }
        value
    }

    /// Reads a number in an Exp-Golomb code; `None` if it has more than 32 bits, which no encoder
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

    #[inline(always)]
    fn widen(&mut self, split: u32) -> bool {
        let bit = self.code >= split;
        if bit {
            self.code -= split;
            self.range -= split;
            self.normalise();
        } else {
            self.range = split;
            self.normalise();
        }
        bit
    }

    #[inline(always)]
    fn normalise(&mut self) {
        while self.range < TOP {
            self.range <<= 8;
            self.pull();
        }
    }

    #[inline(always)]
    fn pull(&mut self) {
        let byte = self.rest.next().copied().unwrap_or(0);
        self.code = self.code << 8 | u32::from(byte);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[derive(Clone, Debug)]
    enum Symbol {
        Bit(usize, bool),
        Plain(u32, u32),
        Golomb(u32, u32),
        Signed(i32, u32),
    }

    impl Symbol {
        fn encode(&self, encoder: &mut Encoder<'_>, models: &mut [Model; 4]) {
            match *self {
                Symbol::Bit(model, bit) => encoder.bit(&mut models[model], bit),
                Symbol::Plain(value, count) => encoder.plain(value, count),
                Symbol::Golomb(value, order) => encoder.golomb(value, order),
                Symbol::Signed(value, order) => encoder.signed(value, order),
            }
        }
    }

    fn steps() -> impl Strategy<Value = std::vec::Vec<Symbol>> {
        let skewed = (0usize..4, prop::bool::weighted(0.03)).prop_map(|(m, b)| Symbol::Bit(m, b));
        let step = prop_oneof![
            8 => skewed,
            2 => (0usize..4, any::<bool>()).prop_map(|(m, b)| Symbol::Bit(m, b)),
            1 => (any::<u32>(), 0u32..=32).prop_map(|(v, n)| Symbol::Plain(v, n)),
            1 => (0u32..100_000, 0u32..6).prop_map(|(v, k)| Symbol::Golomb(v, k)),
            1 => (any::<u32>(), 0u32..6).prop_map(|(v, k)| Symbol::Golomb(v, k)),
            1 => (any::<u32>(), 0u32..6).prop_map(|(v, k)| Symbol::Golomb(u32::MAX - v % 40, k)),
            1 => (-40_000i32..40_000, 0u32..6).prop_map(|(v, k)| Symbol::Signed(v, k)),
            1 => (any::<i32>(), 0u32..6).prop_map(|(v, k)| Symbol::Signed(v, k)),
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
                step.encode(&mut encoder, &mut models);
            }
            prop_assert!(encoder.fits(0));
            let len = encoder.finish().unwrap();
            let mut decoder = Decoder::new(&out[..len]);
            let mut models = [Model(32_768); 4];
            for step in &steps {
                match *step {
                    Symbol::Bit(model, bit) => prop_assert_eq!(decoder.bit(&mut models[model]), bit),
                    Symbol::Plain(value, count) => {
                        let mask = (1u64 << count) - 1;
                        prop_assert_eq!(u64::from(decoder.plain(count)), u64::from(value) & mask);
                    }
                    Symbol::Golomb(value, order) => {
                        prop_assert_eq!(decoder.golomb(order), Some(value));
                    }
                    Symbol::Signed(value, order) => {
                        prop_assert_eq!(decoder.signed(order), Some(value));
                    }
                }
            }
            prop_assert!(decoder.is_exhausted());
        }

        #[test]
        fn rewinding_leaves_no_trace(steps in steps(), other in steps(), at in 0usize..400) {
            let (mut out, mut same) = ([0u8; 4096], [0u8; 4096]);
            let (mut plain, mut rewinding) = (Encoder::new(&mut out), Encoder::new(&mut same));
            for (index, step) in steps.iter().enumerate() {
                if index == at {
                    let checkpoint = rewinding.checkpoint();
                    other.iter().for_each(|step| step.encode(&mut rewinding, &mut [Model(32_768); 4]));
                    rewinding.rewind(checkpoint);
                }
                // Fresh models cause many carries.
                step.encode(&mut plain, &mut [Model(32_768); 4]);
                step.encode(&mut rewinding, &mut [Model(32_768); 4]);
            }
            let (len, same_len) = (plain.finish().unwrap(), rewinding.finish().unwrap());
            prop_assert_eq!(&out[..len], &same[..same_len]);
        }

        #[test]
        fn a_stream_that_fits_is_complete(steps in steps(), room in 0usize..200) {
            let mut out = [0u8; 4096];
            let mut small = [0u8; 200];
            let mut wide = Encoder::new(&mut out);
            let mut tight = Encoder::new(&mut small[..room]);
            let mut models = [Model(32_768); 4];
            for step in &steps {
                if let Symbol::Bit(model, bit) = *step {
                    let mut same = models[model];
                    wide.bit(&mut same, bit);
                    tight.bit(&mut models[model], bit);
                }
            }
            prop_assert!(!tight.fits(room + 1));
            let fits = tight.fits(0);
            let (wide_len, tight_len) = (wide.finish().unwrap(), tight.finish());
            prop_assert!(!fits || tight_len.is_some());
            if let Some(tight_len) = tight_len {
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
        // 2^32 in order 3: 29 ones, a zero, and a remainder of 32 bits (8).
        encoder.plain(u32::MAX, 29);
        encoder.plain(0, 1);
        encoder.plain(8, 32);
        let len = encoder.finish().unwrap();
        assert_eq!(Decoder::new(&out[..len]).golomb(3), None);
    }

    #[test]
    fn a_predictable_stream_is_short() {
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
