//! Consistent overhead byte stuffing (COBS): a frame without zero bytes, terminated by a zero.
//!
//! The decoder is incremental and resynchronises at every delimiter, so it always reads a good
//! frame that follows a corrupt, truncated or oversized one.

use core::fmt;

/// The delimiter between frames.
pub const DELIMITER: u8 = 0;

/// Maximum length on the wire of `raw` bytes, delimiter included.
pub const fn encoded_len(raw: usize) -> usize {
    raw + raw.saturating_sub(1) / 254 + 2
}

/// Writes the concatenation of `parts` as one stuffed frame with its delimiter. Returns its length,
/// or `None` if `out` is too short.
pub fn encode(parts: [&[u8]; 2], out: &mut [u8]) -> Option<usize> {
    let mut code_at = 0;
    let mut code = 1u8;
    let mut len = 1;
    let mut bytes = parts[0].iter().chain(parts[1]).peekable();
    while let Some(&byte) = bytes.next() {
        if byte == DELIMITER {
            *out.get_mut(code_at)? = code;
            code_at = len;
            code = 1;
            len += 1;
        } else {
            *out.get_mut(len)? = byte;
            len += 1;
            code += 1;
            // After a full block, another one follows only if bytes remain.
            if code == 0xFF && bytes.peek().is_some() {
                *out.get_mut(code_at)? = code;
                code_at = len;
                code = 1;
                len += 1;
            }
        }
    }
    *out.get_mut(code_at)? = code;
    *out.get_mut(len)? = DELIMITER;
    Some(len + 1)
}

/// Why the bytes between two delimiters are not a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CobsError {
    /// A delimiter came before the end of the announced block.
    Truncated,
    /// The frame exceeds the decoder's buffer.
    TooLong,
}

impl fmt::Display for CobsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Truncated => "the frame is truncated: its last block is incomplete",
            Self::TooLong => "the frame is longer than the receive buffer",
        })
    }
}

impl core::error::Error for CobsError {}

/// Collects frames of at most `N` unstuffed bytes from a stream, one at a time.
#[derive(Debug)]
pub struct Decoder<const N: usize> {
    buffer: [u8; N],
    len: usize,
    /// Number of data bytes before the next code byte.
    left: u8,
    /// Whether a zero byte follows the current block (unless the frame ends with the block).
    zero_after: bool,
    started: bool,
    too_long: bool,
}

impl<const N: usize> Default for Decoder<N> {
    fn default() -> Self {
        Self { buffer: [0; N], len: 0, left: 0, zero_after: false, started: false, too_long: false }
    }
}

impl<const N: usize> Decoder<N> {
    /// Consumes `input` up to the end of the next frame and returns the frame's contents, which may
    /// be decrypted in place. `None` once the input is used up. Consecutive delimiters are skipped.
    pub fn next(&mut self, input: &mut &[u8]) -> Option<Result<&mut [u8], CobsError>> {
        while let Some((&byte, rest)) = input.split_first() {
            *input = rest;
            if byte != DELIMITER {
                self.push(byte);
                continue;
            }
            let (started, left, too_long, len) = (self.started, self.left, self.too_long, self.len);
            self.restart();
            if !started {
                continue;
            }
            return Some(if too_long {
                Err(CobsError::TooLong)
            } else if left != 0 {
                Err(CobsError::Truncated)
            } else {
                Ok(self.buffer.get_mut(..len).unwrap_or_default())
            });
        }
        None
    }

    /// Discards a partly received frame.
    pub fn restart(&mut self) {
        self.len = 0;
        self.left = 0;
        self.zero_after = false;
        self.started = false;
        self.too_long = false;
    }

    fn push(&mut self, byte: u8) {
        self.started = true;
        if self.left == 0 {
            if self.zero_after {
                self.keep(0);
            }
            self.left = byte - 1;
            self.zero_after = byte != 0xFF;
        } else {
            self.left -= 1;
            self.keep(byte);
        }
    }

    fn keep(&mut self, byte: u8) {
        match self.buffer.get_mut(self.len) {
            Some(slot) => {
                *slot = byte;
                self.len += 1;
            }
            None => self.too_long = true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_stuffed_frame_reads_back(raw in proptest::collection::vec(
            prop_oneof![Just(0u8), Just(1u8), any::<u8>()], 0..600), split in 0usize..600) {
            let mut wire = [0u8; 700];
            let split = split.min(raw.len());
            let len = encode([&raw[..split], &raw[split..]], &mut wire).unwrap();
            prop_assert!(len <= encoded_len(raw.len()));
            prop_assert!(!wire[..len - 1].contains(&0));
            let mut decoder = Decoder::<600>::default();
            let mut input = &wire[..len];
            let frame = decoder.next(&mut input).unwrap();
            prop_assert_eq!(frame.map(|frame| &*frame), Ok(&raw[..]));
        }

        #[test]
        fn a_good_frame_after_garbage_is_read(garbage in proptest::collection::vec(any::<u8>(), 0..200)) {
            let mut wire = garbage.clone();
            wire.push(DELIMITER);
            let mut good = [0u8; 16];
            let len = encode([&[1, 0, 2], &[0, 0]], &mut good).unwrap();
            wire.extend_from_slice(&good[..len]);
            let mut decoder = Decoder::<32>::default();
            let mut input = &wire[..];
            let mut last = false;
            while let Some(frame) = decoder.next(&mut input) {
                last = frame == Ok(&mut [1, 0, 2, 0, 0][..]);
            }
            prop_assert!(last);
        }
    }

    #[test]
    fn a_full_block_needs_no_second_code() {
        let raw = [7u8; 254];
        let mut wire = [0u8; 260];
        assert_eq!(encode([&raw, &[]], &mut wire), Some(256));
        assert_eq!(encode([&raw, &[1]], &mut wire), Some(258));
        assert_eq!(encode([&raw, &[]], &mut wire[..255]), None);
    }
}
