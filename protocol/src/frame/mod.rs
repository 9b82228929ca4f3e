//! Frames: a two-byte header, messages and a seal, stuffed and delimited.
//!
//! | part | bytes |
//! |---|---|
//! | stuffing | 1 (and 1 for each further 254) |
//! | header: sealed (1 bit), version (2), kind (2), sequence number (11), little-endian | 2 |
//! | messages | any |
//! | seal | 4 |
//! | delimiter | 1 |
//!
//! That is a frame of an open link. In a sealed frame the robot and a counter follow the header, the
//! messages are encrypted, and a tag of 16 bytes takes the place of the seal.

pub mod cobs;
mod seal;

pub use seal::{
    ANSWER_CLEAR_LEN, Attempt, HELLO_CLEAR_LEN, KEY_LEN, Key, MAX_SEALED_HANDSHAKE, SEAL_LEN,
    SEALED_LEN, SESSION_CLEAR_LEN, SealSupport, SessionKey, Stray, TAG_LEN, echo_of, open,
    open_answer, open_hello, open_session, seal, seal_answer, seal_hello, seal_session,
};

pub use crate::{
    message::{Direction, SEQUENCE_MODULUS},
    units::SessionId,
};

/// The version of the wire format that this crate speaks.
pub const VERSION: u8 = 1;
/// The oldest version that this crate understands.
pub const MIN_VERSION: u8 = 1;

/// Size of a frame header in bytes.
pub const HEADER_LEN: usize = 2;
/// The smallest frame size that two sides may agree on, in bytes on the wire.
pub const MIN_FRAME: usize = 32;
/// The smallest frame size that two sides of a sealed link may agree on: it holds as many messages
/// as [`MIN_FRAME`] of an open one.
pub const MIN_SEALED_FRAME: usize = 48;
/// The default frame size in bytes on the wire: fits small radios.
pub const DEFAULT_FRAME: usize = 250;
/// The largest frame size that two sides may agree on, in bytes on the wire.
pub const MAX_FRAME: usize = 1024;

/// Number of bytes for messages in a frame of `frame` bytes on the wire of an open link.
pub const fn payload_capacity(frame: usize) -> usize {
    raw_capacity(frame).saturating_sub(HEADER_LEN + SEAL_LEN)
}

/// Number of bytes for messages in a sealed frame of `frame` bytes on the wire.
pub const fn sealed_payload_capacity(frame: usize) -> usize {
    raw_capacity(frame).saturating_sub(SEALED_LEN)
}

const fn raw_capacity(frame: usize) -> usize {
    // Stuffing takes one byte for each 254 bytes or part of them; the delimiter takes one.
    let raw = frame.saturating_sub(2);
    raw - raw / 255
}

const _: () = assert!(sealed_payload_capacity(MIN_SEALED_FRAME) == payload_capacity(MIN_FRAME));

/// How a frame is delivered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameKind {
    /// Sent outside of any session: Hello, Welcome, Refusal, Reset.
    Handshake,
    /// Retransmitted until it is acknowledged.
    Reliable,
    /// Best effort: sent once, superseded by the next one.
    Datagram,
}

/// The header of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// The version of the wire format, 0 to 3.
    pub version: u8,
    /// How the frame is delivered.
    pub kind: FrameKind,
    /// The sequence number modulo 2,048; reliable frames and datagrams are numbered separately.
    pub sequence: u16,
}

/// The bit of a header that marks a sealed frame.
const SEALED: u16 = 1 << 15;

/// Whether a frame is marked as sealed.
pub fn is_sealed(contents: &[u8]) -> bool {
    contents.get(1).is_some_and(|high| u16::from_le_bytes([0, *high]) & SEALED != 0)
}

impl Header {
    /// The header's bytes in a frame of an open link.
    pub fn encode(self) -> [u8; HEADER_LEN] {
        self.word().to_le_bytes()
    }

    /// The header's bytes in a sealed frame.
    pub fn encode_sealed(self) -> [u8; HEADER_LEN] {
        (self.word() | SEALED).to_le_bytes()
    }

    fn word(self) -> u16 {
        let kind = match self.kind {
            FrameKind::Handshake => 0u16,
            FrameKind::Reliable => 1,
            FrameKind::Datagram => 2,
        };
        (self.sequence % SEQUENCE_MODULUS) | (kind << 11) | (u16::from(self.version & 3) << 13)
    }

    /// Splits a frame's contents into header, sealed or not, and the rest. `None` if they are
    /// shorter than a header or the kind is the reserved one.
    pub fn decode(contents: &[u8]) -> Option<(Self, &[u8])> {
        let (head, payload) = contents.split_first_chunk::<HEADER_LEN>()?;
        let word = u16::from_le_bytes(*head);
        let kind = match word >> 11 & 3 {
            0 => FrameKind::Handshake,
            1 => FrameKind::Reliable,
            2 => FrameKind::Datagram,
            _ => return None,
        };
        let version = (word >> 13 & 3) as u8;
        let header = Self { version, kind, sequence: word % SEQUENCE_MODULUS };
        Some((header, payload))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_read_back() {
        for kind in [FrameKind::Handshake, FrameKind::Reliable, FrameKind::Datagram] {
            let header = Header { version: 3, kind, sequence: 2047 };
            for (bytes, sealed) in [(header.encode(), false), (header.encode_sealed(), true)] {
                assert_eq!(Header::decode(&bytes), Some((header, &[][..])));
                assert_eq!(is_sealed(&bytes), sealed);
            }
        }
        assert_eq!(Header::decode(&[1]), None);
        assert_eq!(Header::decode(&0x1800u16.to_le_bytes()), None);
    }

    #[test]
    fn a_full_payload_fits_its_frame() {
        for frame in MIN_FRAME..=MAX_FRAME {
            let open = payload_capacity(frame) + HEADER_LEN + SEAL_LEN;
            let sealed = sealed_payload_capacity(frame) + SEALED_LEN;
            for raw in [open, sealed] {
                let worst = [1u8; MAX_FRAME];
                let mut wire = [0u8; MAX_FRAME + 8];
                let len = cobs::encode([&worst[..raw], &[]], &mut wire).unwrap();
                assert!(len <= frame && len + 2 >= frame, "{frame}: {len}");
            }
        }
        assert_eq!(DEFAULT_FRAME - sealed_payload_capacity(DEFAULT_FRAME), 24);
        assert_eq!(DEFAULT_FRAME - payload_capacity(DEFAULT_FRAME), 8);
    }
}
