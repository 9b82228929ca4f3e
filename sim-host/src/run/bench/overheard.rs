//! What a robot tells to whoever listens: its Hello, and that it is in a session with some server.

use ubimap_protocol::{
    frame::{
        Direction, FrameKind, Header, MAX_FRAME, SEAL_LEN, SessionId, VERSION, cobs, is_sealed,
        open,
    },
    message::{Hello, Messages, State, TimeRequest, ToServer, ToServerKind},
    units::RobotId,
};

/// The lengths of a sealed Hello's contents (SPEC 12.3).
const SEALED_HELLO: std::ops::RangeInclusive<usize> = 28..=62;
/// The shortest contents of a sealed frame of a session (SPEC 12.3).
const SEALED_FRAME: usize = 22;

/// Something that a robot has told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overheard {
    /// It asks for a session.
    Hello(Hello),
    /// It asks for a sealed session; its number and its boot are readable without a key.
    SealedHello {
        /// The robot's number.
        robot: RobotId,
        /// The number of its boot.
        boot: u32,
    },
    /// It has a session with a server, or had one with a server that has gone.
    Session,
    /// The same on a sealed link. A single frame of noise can look like that.
    SealedSession(RobotId),
}

/// Listens to the bytes from a port, without a session and without an answer.
#[derive(Debug, Default)]
pub struct Ear {
    decoder: cobs::Decoder<MAX_FRAME>,
    bytes: u64,
}

impl Ear {
    /// Processes bytes, in pieces of any size. Returns what the robot has told in them.
    pub fn hear(&mut self, mut bytes: &[u8]) -> Vec<Overheard> {
        self.bytes += bytes.len() as u64;
        let mut heard = Vec::new();
        while let Some(frame) = self.decoder.next(&mut bytes) {
            heard.extend(frame.ok().and_then(|contents| told(contents)));
        }
        heard
    }

    /// Number of bytes received, noise included.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }
}

/// What the contents of a frame tell.
fn told(contents: &[u8]) -> Option<Overheard> {
    let (header, rest) = Header::decode(contents)?;
    let is_handshake = header.kind == FrameKind::Handshake;
    if is_sealed(contents) {
        let word = |at: usize| Some(u16::from_le_bytes([*rest.get(at)?, *rest.get(at + 1)?]));
        let robot = RobotId(word(0)?);
        let is_hello = SEALED_HELLO.contains(&contents.len()) && header.sequence == 0;
        return match is_handshake {
            true if is_hello => {
                let boot = u32::from(word(2)?) | u32::from(word(4)?) << 16;
                Some(Overheard::SealedHello { robot, boot })
            }
            false if header.version == VERSION && contents.len() >= SEALED_FRAME => {
                Some(Overheard::SealedSession(robot))
            }
            _ => None,
        };
    }
    if is_handshake {
        let opened = open(SessionId::NONE, Direction::ToServer, contents)?;
        let (_, payload) = Header::decode(opened)?;
        let first = Messages::<ToServer>::new(payload).next()?.ok()?;
        return first.decode().ok().map(Overheard::Hello);
    }
    // Its seal can't be checked without the session's number, so all of its messages must be readable.
    let payload = rest.get(..rest.len().checked_sub(SEAL_LEN)?)?;
    let mut messages = Messages::<ToServer>::new(payload).peekable();
    messages.peek()?;
    let is_one = header.version == VERSION
        && messages.all(|message| {
            message.is_ok_and(|message| match message.kind() {
                Some(ToServerKind::TimeRequest) => message.decode::<TimeRequest>().is_ok(),
                Some(ToServerKind::State) => message.decode::<State>().is_ok(),
                kind => kind.is_some(),
            })
        });
    is_one.then_some(Overheard::Session)
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::{
        message::{SealedReset, ToRobot},
        units::Millimetres,
    };

    use super::*;
    use crate::conformance::{Frame, Note, stuffed};

    const HELLO: Hello = Hello {
        version: 1,
        min_version: 1,
        robot: RobotId(7),
        nonce: 9,
        frame: 250,
        resolution: Millimetres(50),
        fused_tiles: 16,
    };

    fn frame(session: u32, kind: FrameKind, notes: &[Note]) -> Vec<u8> {
        Frame::new(SessionId(session), Direction::ToServer, (kind, 0), notes).wire()
    }

    #[test]
    fn a_robot_is_heard_between_noise_and_in_pieces() {
        let hello = Note::new::<ToServer, _>(&HELLO);
        let request = Note::new::<ToServer, _>(&TimeRequest { nonce: 3 });
        let sealed = |first: u8, len: usize| {
            let mut contents = vec![first, 0xA0, 8, 0, 5, 0, 0, 0];
            contents.resize(len, 0x77);
            stuffed(&contents)
        };
        let bytes = [
            vec![0x55; 300],
            vec![0],
            frame(0, FrameKind::Handshake, std::slice::from_ref(&hello)),
            frame(5, FrameKind::Datagram, std::slice::from_ref(&request)),
            // A Hello with a wrong seal, a frame without messages, and messages that are none.
            frame(6, FrameKind::Handshake, &[hello]),
            frame(5, FrameKind::Reliable, &[]),
            frame(5, FrameKind::Datagram, &[Note { number: 4, body: vec![9] }]),
            frame(5, FrameKind::Datagram, &[Note { number: 99, body: vec![9] }]),
            // Of the server, as a sender that hears its own echo.
            Frame::new(
                SessionId::NONE,
                Direction::ToRobot,
                (FrameKind::Handshake, 0),
                &[Note::new::<ToRobot, _>(&SealedReset { echo: 4 })],
            )
            .wire(),
            sealed(0, 40),
            sealed(0, 27),
            stuffed(&[&[1, 0xB0, 8, 0, 5, 0][..], &[0x77; 20]].concat()),
        ]
        .concat();
        let expected = [
            Overheard::Hello(HELLO),
            Overheard::Session,
            Overheard::SealedHello { robot: RobotId(8), boot: 5 },
            Overheard::SealedSession(RobotId(8)),
        ];
        for size in [1, 7, bytes.len()] {
            let mut ear = Ear::default();
            let heard: Vec<_> = bytes.chunks(size).flat_map(|piece| ear.hear(piece)).collect();
            assert_eq!(heard, expected, "pieces of {size}");
            assert_eq!(ear.bytes(), bytes.len() as u64);
        }
    }
}
