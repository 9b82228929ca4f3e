//! The seal of a frame: what tells a good frame of this session from anything else.
//!
//! On a trusted wire it is a CRC-32. It is computed over the session and the direction as well,
//! though these do not travel: a frame of another session, or one's own echo, does not pass.

use crc::{CRC_32_ISO_HDLC, Crc};

/// Bytes that the seal adds to a frame.
pub const SEAL_LEN: usize = 4;

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// Which way a frame goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Direction {
    /// From a robot to the server.
    ToServer = 0,
    /// From the server to a robot.
    ToRobot = 1,
}

/// The number of a session, chosen by the server; zero outside any session (handshake).
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize,
)]
pub struct SessionId(pub u32);

impl SessionId {
    /// No session: the frames of the handshake.
    pub const NONE: Self = Self(0);
}

/// The seal of a frame's header and payload.
pub fn seal(session: SessionId, direction: Direction, contents: &[u8]) -> [u8; SEAL_LEN] {
    let mut digest = CRC.digest();
    digest.update(&session.0.to_le_bytes());
    digest.update(&[direction as u8]);
    digest.update(contents);
    digest.finalize().to_le_bytes()
}

/// The header and payload of a frame whose seal is good, or `None`.
pub fn open(session: SessionId, direction: Direction, frame: &[u8]) -> Option<&[u8]> {
    let (contents, found) = frame.split_at_checked(frame.len().checked_sub(SEAL_LEN)?)?;
    // A fuzzer would spend its time on checksums.
    let good = seal(session, direction, contents) == found || cfg!(fuzzing);
    good.then_some(contents)
}

/// The CRC-32 (ISO-HDLC) of some bytes; also the hash of tiles and maps.
pub fn crc32(parts: &[&[u8]]) -> u32 {
    let mut digest = CRC.digest();
    for part in parts {
        digest.update(part);
    }
    digest.finalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_crc_is_the_catalogues() {
        assert_eq!(crc32(&[b"123456789"]), 0xCBF4_3926);
    }

    #[test]
    fn a_seal_holds_for_one_session_and_direction() {
        let contents = [1, 2, 3];
        let mut frame = [0u8; 7];
        frame[..3].copy_from_slice(&contents);
        frame[3..].copy_from_slice(&seal(SessionId(9), Direction::ToServer, &contents));
        assert_eq!(open(SessionId(9), Direction::ToServer, &frame), Some(&contents[..]));
        assert_eq!(open(SessionId(8), Direction::ToServer, &frame), None);
        assert_eq!(open(SessionId(9), Direction::ToRobot, &frame), None);
        assert_eq!(open(SessionId(9), Direction::ToServer, &frame[..3]), None);
    }
}
