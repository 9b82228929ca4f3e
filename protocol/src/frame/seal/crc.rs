//! The seal of an open link: a checksum that accepts undamaged frames of this session only.
//!
//! It is a CRC-32, which is enough on a trusted wire. It also covers the session and the direction,
//! which are not transmitted, so that frames of other sessions and a sender's own echo fail the
//! check.

use crate::{checksum::CRC, message::Direction, units::SessionId};

/// Size of the seal in bytes.
pub const SEAL_LEN: usize = 4;

/// The seal of `contents`, a frame's header and payload.
pub fn seal(session: SessionId, direction: Direction, contents: &[u8]) -> [u8; SEAL_LEN] {
    let mut digest = CRC.digest();
    digest.update(&session.0.to_le_bytes());
    digest.update(&[direction as u8]);
    digest.update(contents);
    digest.finalize().to_le_bytes()
}

/// The header and payload of `frame` if its seal is good, otherwise `None`.
pub fn open(session: SessionId, direction: Direction, frame: &[u8]) -> Option<&[u8]> {
    let (contents, found) = frame.split_at_checked(frame.len().checked_sub(SEAL_LEN)?)?;
    // A fuzzer may use any seal, as it would otherwise spend its time on guessing checksums.
    let good = seal(session, direction, contents) == found || cfg!(fuzzing);
    good.then_some(contents)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seal_is_valid_for_one_session_and_direction() {
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
