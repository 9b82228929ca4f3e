//! The header of a frame.

use crate::message::SEQUENCE_MODULUS;

/// The version of the wire format that this crate speaks.
pub const VERSION: u8 = 1;
/// The oldest version that this crate understands.
pub const MIN_VERSION: u8 = 1;

/// Size of a frame header in bytes.
pub const HEADER_LEN: usize = 2;

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
}
