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
mod header;
mod seal;

pub use header::{FrameKind, HEADER_LEN, Header, MIN_VERSION, VERSION, is_sealed};
pub use seal::{
    ANSWER_CLEAR_LEN, Attempt, HELLO_CLEAR_LEN, KEY_LEN, Key, MAX_SEALED_HANDSHAKE, SEAL_LEN,
    SEALED_LEN, SESSION_CLEAR_LEN, SealSlot, SealSupport, SessionKey, Stray, TAG_LEN, echo_of,
    open, open_answer, open_hello, open_session, seal, seal_answer, seal_hello, seal_session,
};

pub use crate::{
    message::{Direction, SEQUENCE_MODULUS},
    units::SessionId,
};

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

#[cfg(test)]
mod tests {
    use super::*;

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
