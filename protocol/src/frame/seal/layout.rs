//! Sealed frames: the clear bytes, nonce and associated data of each kind.
//!
//! | frame | key | clear bytes | nonce |
//! |---|---|---|---|
//! | Hello | the robot's | header, robot, boot, clock | 1, 0, robot, boot, clock |
//! | Welcome, Refusal, Reset | the robot's | header, robot, salt | 2, 0, robot, 0, salt |
//! | of a session | the session's | header, robot, counter (16 bits) | 3, direction, robot, 0, session, counter |
//!
//! The key of a session is the tag of an empty text with the nonce 0, 0, robot, boot, clock. The
//! first byte of a nonce keeps the kinds apart; the rest never repeats: a stamp of an attempt grows,
//! a salt and a counter count. The associated data are the clear bytes; those of an answer to a
//! Hello are followed by the boot and the clock of that Hello.

use super::ascon::{Key, NONCE_LEN, TAG_LEN};
use crate::{
    frame::{FrameKind, HEADER_LEN, Header, VERSION},
    message::Direction,
    units::{RobotId, SessionId},
};

/// Length of the clear bytes of a session's frame.
pub const SESSION_CLEAR_LEN: usize = HEADER_LEN + 2 + 2;
/// Length of the clear bytes of a Hello.
pub const HELLO_CLEAR_LEN: usize = HEADER_LEN + 2 + STAMP_LEN;
/// Length of the clear bytes of an answer: a Welcome, a Refusal or a Reset.
pub const ANSWER_CLEAR_LEN: usize = HEADER_LEN + 2 + 8;
/// Number of bytes that sealing adds to the messages of a session's frame, before stuffing.
pub const SEALED_LEN: usize = SESSION_CLEAR_LEN + TAG_LEN;
/// The longest sealed frame of the handshake on the wire.
pub const MAX_SEALED_HANDSHAKE: usize = 64;

const STAMP_LEN: usize = 4 + 8;

/// A robot's attempt to open a session: its boot counter, and its clock in microseconds when the
/// attempt began. Each attempt of a robot must be later than all before, also across its boots.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Attempt {
    /// The number of the boot, counted in memory that survives it.
    pub boot: u32,
    /// The robot's clock in microseconds; higher than that of earlier attempts since the boot.
    pub clock: u64,
}

impl Attempt {
    fn to_bytes(self) -> [u8; STAMP_LEN] {
        join(&[&self.boot.to_le_bytes(), &self.clock.to_le_bytes()])
    }
}

/// A sealed frame of a session that could not be opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stray {
    /// The robot that it names.
    pub robot: RobotId,
    /// The first eight bytes of its tag: see [`echo_of`].
    pub echo: u64,
}

/// The key of one session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionKey(Key);

impl SessionKey {
    /// The key of the session that an answer with this salt opens for an attempt.
    pub fn derive(
        key: &Key,
        robot: RobotId,
        attempt: Attempt,
        salt: u64,
        session: SessionId,
    ) -> Self {
        let nonce = nonce(0, 0, robot, &attempt.to_bytes());
        let both: [u8; 12] = join(&[&salt.to_le_bytes(), &session.0.to_le_bytes()]);
        Self(key.derived(key.seal(&nonce, &both, &mut [])))
    }
}

impl Key {
    /// A number that tells keys apart and says nothing about them: the first four bytes of the tag of
    /// an empty text, with a nonce that is used for nothing else.
    pub fn fingerprint(&self) -> u32 {
        let tag = self.seal(&[0xFF; NONCE_LEN], &[], &mut []);
        tag.first_chunk().map_or(0, |print| u32::from_be_bytes(*print))
    }
}

/// The first eight bytes of a tag: a Reset names the frame that it answers by them.
pub fn echo_of(tag: &[u8; TAG_LEN]) -> u64 {
    tag.first_chunk().map_or(0, |echo| u64::from_le_bytes(*echo))
}

/// Seals `text` in place as a frame of a session, and returns the clear bytes and the tag.
pub fn seal_session(
    key: &SessionKey,
    (robot, session): (RobotId, SessionId),
    direction: Direction,
    header: Header,
    counter: u32,
    text: &mut [u8],
) -> ([u8; SESSION_CLEAR_LEN], [u8; TAG_LEN]) {
    let low = counter as u16;
    let clear = join(&[&header.encode_sealed(), &robot.0.to_le_bytes(), &low.to_le_bytes()]);
    let nonce = session_nonce(robot, session, direction, counter);
    (clear, key.0.seal(&nonce, &clear, text))
}

/// Opens the text of a session's frame in place, given its clear bytes and its whole counter.
/// Returns false if the tag is wrong; the text is then zeroed.
pub fn open_session(
    key: &SessionKey,
    (robot, session): (RobotId, SessionId),
    direction: Direction,
    clear: &[u8; SESSION_CLEAR_LEN],
    counter: u32,
    (text, tag): (&mut [u8], &[u8; TAG_LEN]),
) -> bool {
    key.0.open(&session_nonce(robot, session, direction, counter), clear, text, tag)
}

/// Seals the message of a Hello in place, and returns the clear bytes and the tag.
pub fn seal_hello(
    key: &Key,
    robot: RobotId,
    attempt: Attempt,
    text: &mut [u8],
) -> ([u8; HELLO_CLEAR_LEN], [u8; TAG_LEN]) {
    let stamp = attempt.to_bytes();
    let clear = join(&[&HANDSHAKE.encode_sealed(), &robot.0.to_le_bytes(), &stamp]);
    (clear, key.seal(&nonce(1, 0, robot, &stamp), &clear, text))
}

/// Opens the message of a Hello in place. Returns false if the tag is wrong; the text is then
/// zeroed.
pub fn open_hello(
    key: &Key,
    robot: RobotId,
    attempt: Attempt,
    clear: &[u8; HELLO_CLEAR_LEN],
    (text, tag): (&mut [u8], &[u8; TAG_LEN]),
) -> bool {
    key.open(&nonce(1, 0, robot, &attempt.to_bytes()), clear, text, tag)
}

/// Seals the message of an answer in place, and returns the clear bytes and the tag. `attempt` is
/// that of the Hello that it answers; `None` for a Reset.
pub fn seal_answer(
    key: &Key,
    robot: RobotId,
    salt: u64,
    attempt: Option<Attempt>,
    text: &mut [u8],
) -> ([u8; ANSWER_CLEAR_LEN], [u8; TAG_LEN]) {
    let clear = join(&[&HANDSHAKE.encode_sealed(), &robot.0.to_le_bytes(), &salt.to_le_bytes()]);
    let (associated, len) = answer_data(&clear, attempt);
    let associated = associated.get(..len).unwrap_or_default();
    (clear, key.seal(&answer_nonce(robot, salt), associated, text))
}

/// Opens the message of an answer in place. Returns false if the tag is wrong; the text is then
/// zeroed.
pub fn open_answer(
    key: &Key,
    robot: RobotId,
    salt: u64,
    attempt: Option<Attempt>,
    clear: &[u8; ANSWER_CLEAR_LEN],
    (text, tag): (&mut [u8], &[u8; TAG_LEN]),
) -> bool {
    let (associated, len) = answer_data(clear, attempt);
    let associated = associated.get(..len).unwrap_or_default();
    key.open(&answer_nonce(robot, salt), associated, text, tag)
}

const HANDSHAKE: Header = Header { version: VERSION, kind: FrameKind::Handshake, sequence: 0 };

/// The associated data of an answer and their length.
fn answer_data(
    clear: &[u8; ANSWER_CLEAR_LEN],
    attempt: Option<Attempt>,
) -> ([u8; ANSWER_CLEAR_LEN + STAMP_LEN], usize) {
    let stamp = attempt.map(Attempt::to_bytes);
    let stamp = stamp.as_ref().map_or(&[][..], |stamp| stamp);
    (join(&[clear, stamp]), ANSWER_CLEAR_LEN + stamp.len())
}

fn answer_nonce(robot: RobotId, salt: u64) -> [u8; NONCE_LEN] {
    nonce(2, 0, robot, &join(&[&[0; 4], &salt.to_le_bytes()]))
}

fn session_nonce(
    robot: RobotId,
    session: SessionId,
    direction: Direction,
    counter: u32,
) -> [u8; NONCE_LEN] {
    let rest = join(&[&[0; 4], &session.0.to_le_bytes(), &counter.to_le_bytes()]);
    nonce(3, direction as u8, robot, &rest)
}

fn nonce(label: u8, direction: u8, robot: RobotId, rest: &[u8; STAMP_LEN]) -> [u8; NONCE_LEN] {
    join(&[&[label, direction], &robot.0.to_le_bytes(), rest])
}

/// The concatenation of `parts`, followed by zeros if it is shorter.
fn join<const N: usize>(parts: &[&[u8]]) -> [u8; N] {
    let mut all = [0; N];
    let bytes = parts.iter().flat_map(|part| part.iter());
    all.iter_mut().zip(bytes).for_each(|(to, from)| *to = *from);
    all
}
