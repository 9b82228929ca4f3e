//! The seal of a frame: what tells a good frame of this session from anything else.
//!
//! On a trusted wire it is a CRC-32. It is computed over the session and the direction as well,
//! though these do not travel: a frame of another session, or one's own echo, does not pass.

use crate::{checksum::CRC, message::Direction, units::SessionId};

/// Bytes that the seal adds to a frame.
pub const SEAL_LEN: usize = 4;

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

#[cfg(test)]
mod tests {
    use super::*;

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
