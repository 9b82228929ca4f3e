//! Frames: a two-byte header, messages and a seal, stuffed and delimited.
//!
//! | part | bytes |
//! |---|---|
//! | stuffing | 1 (and 1 for each further 254) |
//! | header: version (3 bits), kind (2), sequence number (11), little-endian | 2 |
//! | messages | any |
//! | seal | 4 |
//! | delimiter | 1 |

pub mod cobs;
mod seal;

pub use seal::{SEAL_LEN, open, seal};

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
/// The default frame size in bytes on the wire: fits small radios.
pub const DEFAULT_FRAME: usize = 250;
/// The largest frame size that two sides may agree on, in bytes on the wire.
pub const MAX_FRAME: usize = 1024;

/// Number of bytes for messages in a frame of `frame` bytes on the wire.
pub const fn payload_capacity(frame: usize) -> usize {
    // Stuffing takes one byte for each 254 bytes or part of them; the delimiter takes one.
    let raw = frame.saturating_sub(2);
    let raw = raw - raw / 255;
    raw.saturating_sub(HEADER_LEN + SEAL_LEN)
}

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
    /// The version of the wire format, 0 to 7.
    pub version: u8,
    /// How the frame is delivered.
    pub kind: FrameKind,
    /// The sequence number modulo 2,048; reliable frames and datagrams are numbered separately.
    pub sequence: u16,
}

impl Header {
    /// The header's bytes on the wire.
    pub fn encode(self) -> [u8; HEADER_LEN] {
        let kind = match self.kind {
            FrameKind::Handshake => 0u16,
            FrameKind::Reliable => 1,
            FrameKind::Datagram => 2,
        };
        let word =
            (self.sequence % SEQUENCE_MODULUS) | (kind << 11) | (u16::from(self.version & 7) << 13);
        word.to_le_bytes()
    }

    /// Splits a frame's contents into header and messages. `None` if they are shorter than a header
    /// or the kind is the reserved one.
    pub fn decode(contents: &[u8]) -> Option<(Self, &[u8])> {
        let (head, payload) = contents.split_first_chunk::<HEADER_LEN>()?;
        let word = u16::from_le_bytes(*head);
        let kind = match word >> 11 & 3 {
            0 => FrameKind::Handshake,
            1 => FrameKind::Reliable,
            2 => FrameKind::Datagram,
            _ => return None,
        };
        let header = Self { version: (word >> 13) as u8, kind, sequence: word % SEQUENCE_MODULUS };
        Some((header, payload))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_read_back() {
        for kind in [FrameKind::Handshake, FrameKind::Reliable, FrameKind::Datagram] {
            let header = Header { version: 5, kind, sequence: 2047 };
            let bytes = header.encode();
            assert_eq!(Header::decode(&bytes), Some((header, &[][..])));
        }
        assert_eq!(Header::decode(&[1]), None);
        assert_eq!(Header::decode(&0x1800u16.to_le_bytes()), None);
    }

    #[test]
    fn a_full_payload_fits_its_frame() {
        for frame in MIN_FRAME..=MAX_FRAME {
            let raw = payload_capacity(frame) + HEADER_LEN + SEAL_LEN;
            let worst = [1u8; MAX_FRAME];
            let mut wire = [0u8; MAX_FRAME + 8];
            let len = cobs::encode([&worst[..raw], &[]], &mut wire).unwrap();
            assert!(len <= frame && len + 2 >= frame, "{frame}: {len}");
        }
        assert_eq!(DEFAULT_FRAME - payload_capacity(DEFAULT_FRAME), 8);
    }
}
