//! The frames of a sealed handshake: Hello, and the answers Welcome, Refusal and Reset. Both sides
//! seal them with the robot's key, outside any session.

use core::fmt;

use crate::{
    frame::{
        ANSWER_CLEAR_LEN, Attempt, HEADER_LEN, HELLO_CLEAR_LEN, Key, MAX_SEALED_HANDSHAKE, TAG_LEN,
        cobs, open_answer, open_hello, seal_answer, seal_hello,
    },
    message::{Body, Hello, Message, Messages, ToRobot, ToServer, Traffic, Writer},
    units::RobotId,
};

/// The longest frame before stuffing.
const MAX_RAW: usize = MAX_SEALED_HANDSHAKE - 2;

/// A received handshake frame, still sealed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SealedHandshake<'f> {
    frame: &'f [u8],
    robot: RobotId,
}

impl<'f> SealedHandshake<'f> {
    /// A sealed handshake frame; `None` if it is too short or too long for one.
    pub(super) fn parse(frame: &'f [u8]) -> Option<Self> {
        let (robot, _) = frame.get(HEADER_LEN..)?.split_first_chunk()?;
        let fits = (ANSWER_CLEAR_LEN + TAG_LEN..=MAX_RAW).contains(&frame.len());
        fits.then_some(Self { frame, robot: RobotId(u16::from_le_bytes(*robot)) })
    }

    /// The robot that it names.
    pub fn robot(&self) -> RobotId {
        self.robot
    }

    /// Opens a Hello: the attempt and the message. `None` if the tag is wrong, or the message names
    /// another robot.
    pub fn hello(&self, key: &Key) -> Option<(Attempt, Hello)> {
        let (clear, rest) = self.frame.split_first_chunk::<HELLO_CLEAR_LEN>()?;
        let [_, _, _, _, boot @ .., a, b, c, d, e, f, g, h] = *clear;
        let boot = u32::from_le_bytes(boot);
        let attempt = Attempt { boot, clock: u64::from_le_bytes([a, b, c, d, e, f, g, h]) };
        let opened = Opened::<ToServer>::new(rest, |text, tag| {
            open_hello(key, self.robot, attempt, clear, (text, tag))
        })?;
        let hello = opened.message()?.decode::<Hello>().ok()?;
        (hello.robot == self.robot).then_some((attempt, hello))
    }

    /// Opens an answer: its salt and the message. `attempt` is the robot's, to which a Welcome or a
    /// Refusal must belong; `None` opens a Reset. `None` if the tag is wrong.
    pub fn answer(&self, key: &Key, attempt: Option<Attempt>) -> Option<(u64, Opened<ToRobot>)> {
        let (clear, rest) = self.frame.split_first_chunk::<ANSWER_CLEAR_LEN>()?;
        let (_, salt) = clear.split_last_chunk::<8>()?;
        let salt = u64::from_le_bytes(*salt);
        let opened = Opened::new(rest, |text, tag| {
            open_answer(key, self.robot, salt, attempt, clear, (text, tag))
        })?;
        Some((salt, opened))
    }
}

/// The contents of an opened handshake frame.
pub struct Opened<D> {
    text: [u8; MAX_RAW],
    len: usize,
    direction: core::marker::PhantomData<D>,
}

impl<D: Traffic> Opened<D> {
    fn new(sealed: &[u8], open: impl FnOnce(&mut [u8], &[u8; TAG_LEN]) -> bool) -> Option<Self> {
        let (sealed, tag) = sealed.split_last_chunk::<TAG_LEN>()?;
        let mut text = [0; MAX_RAW];
        let space = text.get_mut(..sealed.len())?;
        space.copy_from_slice(sealed);
        let len = space.len();
        open(space, tag).then_some(Self { text, len, direction: core::marker::PhantomData })
    }

    /// The message, `None` if there is no complete one.
    pub fn message(&self) -> Option<Message<'_, D>> {
        Messages::new(self.text.get(..self.len)?).next()?.ok()
    }
}

impl<D> fmt::Debug for Opened<D> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Opened").field(&self.text.get(..self.len)).finish()
    }
}

/// Writes the sealed frame of a Hello, whose robot it names. Returns its length on the wire, or
/// `None` if it does not fit.
pub fn write_hello(key: &Key, attempt: Attempt, hello: &Hello, out: &mut [u8]) -> Option<usize> {
    write(
        out,
        |writer: &mut Writer<'_, ToServer>| writer.push(hello),
        |text| seal_hello(key, hello.robot, attempt, text),
    )
}

/// Writes the sealed frame of an answer to a robot: to the Hello of an attempt, or a Reset, which
/// has none. No salt may be used twice. Returns its length on the wire, or `None` if it does not
/// fit.
pub fn write_answer<M: Body<ToRobot>>(
    key: &Key,
    (robot, attempt, salt): (RobotId, Option<Attempt>, u64),
    message: &M,
    out: &mut [u8],
) -> Option<usize> {
    write(
        out,
        |writer: &mut Writer<'_, ToRobot>| writer.push(message),
        |text| seal_answer(key, robot, salt, attempt, text),
    )
}

fn write<D: Traffic, const CLEAR: usize>(
    out: &mut [u8],
    push: impl FnOnce(&mut Writer<'_, D>) -> bool,
    seal: impl FnOnce(&mut [u8]) -> ([u8; CLEAR], [u8; TAG_LEN]),
) -> Option<usize> {
    let mut scratch = [0; MAX_RAW];
    let mut writer = Writer::new(scratch.get_mut(..MAX_RAW - CLEAR - TAG_LEN)?);
    if !push(&mut writer) {
        return None;
    }
    let len = writer.len();
    let sealed = scratch.get_mut(..len + TAG_LEN)?;
    let (text, tag) = sealed.split_last_chunk_mut::<TAG_LEN>()?;
    let clear;
    (clear, *tag) = seal(text);
    cobs::encode([&clear, sealed], out)
}

#[cfg(test)]
#[cfg(feature = "seals")]
mod tests {
    use std::vec::Vec;

    use super::*;
    use crate::{
        frame::{DEFAULT_FRAME, SessionId, VERSION, is_sealed},
        message::{SealedReset, Welcome},
        units::Millimetres,
    };

    const KEY: Key = Key::new([7; 16]);
    const ROBOT: RobotId = RobotId(u16::MAX);
    const ATTEMPT: Attempt = Attempt { boot: u32::MAX, clock: u64::MAX };

    /// The longest Hello.
    fn hello() -> Hello {
        Hello {
            version: VERSION,
            min_version: VERSION,
            robot: ROBOT,
            nonce: u32::MAX,
            frame: u16::MAX,
            resolution: Millimetres(i32::MIN),
            fused_tiles: u16::MAX,
        }
    }

    fn welcome() -> Welcome {
        Welcome {
            nonce: u32::MAX,
            version: VERSION,
            session: SessionId(u32::MAX),
            frame: u16::MAX,
            server_epoch: u32::MAX,
            first_epoch: u32::MAX,
            stores: true,
            renumber: true,
        }
    }

    fn raw(write: impl FnOnce(&mut [u8]) -> Option<usize>) -> Vec<u8> {
        let mut out = [0; DEFAULT_FRAME];
        let len = write(&mut out).unwrap();
        assert!(len <= MAX_SEALED_HANDSHAKE, "{len}");
        let mut decoder = cobs::Decoder::<DEFAULT_FRAME>::default();
        decoder.next(&mut &out[..len]).unwrap().unwrap().to_vec()
    }

    fn answer<M: Body<ToRobot>>(attempt: Option<Attempt>, message: &M) -> Vec<u8> {
        raw(|out| write_answer(&KEY, (ROBOT, attempt, u64::MAX), message, out))
    }

    #[test]
    fn the_longest_frames_read_back() {
        let frame = raw(|out| write_hello(&KEY, ATTEMPT, &hello(), out));
        assert!(is_sealed(&frame));
        let sealed = SealedHandshake::parse(&frame).unwrap();
        assert_eq!(sealed.robot(), ROBOT);
        assert_eq!(sealed.hello(&KEY), Some((ATTEMPT, hello())));
        let frame = answer(Some(ATTEMPT), &welcome());
        let (salt, opened) =
            SealedHandshake::parse(&frame).unwrap().answer(&KEY, Some(ATTEMPT)).unwrap();
        assert_eq!((salt, opened.message().unwrap().decode()), (u64::MAX, Ok(welcome())));
        let frame = answer(None, &SealedReset { echo: u64::MAX });
        let (_, opened) = SealedHandshake::parse(&frame).unwrap().answer(&KEY, None).unwrap();
        assert_eq!(opened.message().unwrap().decode(), Ok(SealedReset { echo: u64::MAX }));
    }

    #[test]
    fn a_hello_that_was_changed_anywhere_is_not_opened() {
        let good = raw(|out| write_hello(&KEY, ATTEMPT, &hello(), out));
        let opens = |frame: &[u8], key| {
            SealedHandshake::parse(frame).is_some_and(|sealed| sealed.hello(&key).is_some())
        };
        assert!(opens(&good, KEY) && !opens(&good, Key::new([8; 16])));
        for bit in 0..8 * good.len() {
            let mut changed = good.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            assert!(!opens(&changed, KEY), "bit {bit}");
        }
        for len in 0..good.len() {
            assert!(!opens(&good[..len], KEY), "{len}");
        }
        assert!(!opens(&[&good[..], &[0]].concat(), KEY));
    }

    #[test]
    fn an_answer_is_of_use_for_its_attempt_and_robot_alone() {
        let frame = answer(Some(ATTEMPT), &welcome());
        let sealed = SealedHandshake::parse(&frame).unwrap();
        let others = [
            Attempt { boot: ATTEMPT.boot - 1, ..ATTEMPT },
            Attempt { clock: ATTEMPT.clock - 1, ..ATTEMPT },
        ];
        for other in others {
            assert!(sealed.answer(&KEY, Some(other)).is_none());
        }
        assert!(sealed.answer(&KEY, None).is_none());
        assert!(sealed.answer(&Key::new([8; 16]), Some(ATTEMPT)).is_none());
        for bit in 0..8 * frame.len() {
            let mut changed = frame.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            let opened =
                SealedHandshake::parse(&changed).and_then(|it| it.answer(&KEY, Some(ATTEMPT)));
            assert!(opened.is_none(), "bit {bit}");
        }
        // Nor is a Hello an answer.
        let hello = raw(|out| write_hello(&KEY, ATTEMPT, &hello(), out));
        let hello = SealedHandshake::parse(&hello).unwrap();
        assert!(hello.answer(&KEY, Some(ATTEMPT)).is_none() && hello.answer(&KEY, None).is_none());
    }

    #[test]
    fn a_hello_for_another_robot_than_its_clear_one_is_not_opened() {
        let mut scratch = [0; 64];
        let mut writer = Writer::<ToServer>::new(&mut scratch[..40]);
        assert!(writer.push(&hello()));
        let len = writer.len();
        let (clear, tag) = seal_hello(&KEY, RobotId(9), ATTEMPT, &mut scratch[..len]);
        let frame = [&clear[..], &scratch[..len], &tag].concat();
        assert_eq!(SealedHandshake::parse(&frame).unwrap().hello(&KEY), None);
    }
}
