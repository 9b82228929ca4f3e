//! How frames are sealed: by checksums, or with the keys of robots (SPEC 12).

use std::collections::BTreeMap;

use ubimap_protocol::{
    frame::{
        ANSWER_CLEAR_LEN, Attempt, Direction, FrameKind, HELLO_CLEAR_LEN, Header, Key,
        SESSION_CLEAR_LEN, SessionId, SessionKey, TAG_LEN, echo_of, is_sealed, open_answer,
        open_hello, open_session, seal_answer, seal_hello, seal_session,
    },
    message::{Hello, Message, Refusal, Reset, SealedReset, ToRobot, ToServer, Traffic, Welcome},
    units::RobotId,
};

use super::frames::{Frame, Note, Unreadable, payload, stuffed};

/// The keys of a link.
#[derive(Clone, Debug, Default)]
pub enum Keys {
    /// The link is open.
    #[default]
    None,
    /// Frames are sealed with the key of a robot.
    Of {
        /// The robots with their keys. To a server the runner is the first of them.
        keys: Vec<(RobotId, Key)>,
        /// The salt of the first answer: must never have been used with these keys.
        salt: u64,
        /// The boot of the runner as a robot: higher than all before.
        boot: u32,
    },
}

/// How frames are sealed. It opens whatever was sealed with the right key, however old, and leaves it to its user
/// what to think of that.
#[derive(Debug, Default)]
pub enum Envelope {
    /// By checksums.
    #[default]
    Open,
    /// With the keys of robots.
    Keyed(Box<Keyed>),
}

/// The keys, and what sealing remembers.
#[derive(Debug)]
pub struct Keyed {
    keys: BTreeMap<RobotId, Key>,
    robot: RobotId,
    /// The attempt of each Hello, by its nonce.
    attempts: BTreeMap<u32, Attempt>,
    /// The newest attempt.
    pub(super) attempt: Attempt,
    /// Of the next answer, or of the last one that came.
    salt: u64,
    /// The sessions, newest first.
    sessions: Vec<Sealing>,
    /// The echo of the peer's last frame.
    pub(super) echo: u64,
}

#[derive(Debug)]
struct Sealing {
    session: SessionId,
    key: SessionKey,
    /// The counter of the next frame.
    counter: u32,
    /// The highest counter that came.
    highest: u32,
}

impl Keyed {
    /// `salt` and `boot` must not have been used with these keys before.
    pub(super) fn new(keys: &[(RobotId, Key)], salt: u64, boot: u32) -> Self {
        Self {
            keys: keys.iter().copied().collect(),
            robot: keys.first().map_or(RobotId(0), |(robot, _)| *robot),
            attempts: BTreeMap::new(),
            attempt: Attempt { boot, clock: 0 },
            salt,
            sessions: Vec::new(),
            echo: 0,
        }
    }

    /// The robot whose key is used.
    pub(super) fn robot(&self) -> RobotId {
        self.robot
    }

    fn key(&self) -> Option<Key> {
        self.keys.get(&self.robot).copied()
    }

    fn begin(&mut self, key: &Key, attempt: Attempt, salt: u64, session: SessionId) {
        let key = SessionKey::derive(key, self.robot, attempt, salt, session);
        self.sessions.insert(0, Sealing { session, key, counter: 0, highest: 0 });
        self.sessions.truncate(8);
    }

    fn wire(&mut self, frame: &Frame) -> Option<Vec<u8>> {
        let key = self.key()?;
        let is_handshake = frame.header.kind == FrameKind::Handshake;
        if frame.session != SessionId::NONE {
            return Some(self.session_wire(&key, frame));
        }
        // There is no sealed frame of a session outside of it.
        let note = frame.notes().0.into_iter().next().filter(|_| is_handshake)?;
        match frame.direction {
            Direction::ToServer => {
                let hello =
                    Message::<ToServer>::new(note.number, &note.body).decode::<Hello>().ok()?;
                let next = Attempt { clock: self.attempt.clock + 1, ..self.attempt };
                let attempt = *self.attempts.entry(hello.nonce).or_insert(next);
                self.attempt = self.attempt.max(attempt);
                let mut text = frame.payload.clone();
                let (clear, tag) = seal_hello(&key, self.robot, attempt, &mut text);
                Some(joined(&clear, &text, &tag))
            }
            Direction::ToRobot => {
                let message = Message::<ToRobot>::new(note.number, &note.body);
                let welcome = message.decode::<Welcome>().ok();
                let refusal = message.decode::<Refusal>().ok();
                let nonce = welcome.map(|it| it.nonce).or(refusal.map(|it| it.nonce));
                let attempt =
                    nonce.map(|it| self.attempts.get(&it).copied().unwrap_or(self.attempt));
                self.salt += 1;
                let salt = self.salt;
                if let (Some(welcome), Some(attempt)) = (welcome, attempt) {
                    self.begin(&key, attempt, salt, welcome.session);
                }
                let mut text = match message.decode::<Reset>() {
                    Ok(_) => payload(&[Note::new::<ToRobot, _>(&SealedReset { echo: self.echo })]),
                    Err(_) => frame.payload.clone(),
                };
                let (clear, tag) = seal_answer(&key, self.robot, salt, attempt, &mut text);
                Some(joined(&clear, &text, &tag))
            }
        }
    }

    fn session_wire(&mut self, key: &Key, frame: &Frame) -> Vec<u8> {
        let at = self.sessions.iter().position(|it| it.session == frame.session);
        let at = at.unwrap_or_else(|| {
            self.begin(key, self.attempt, self.salt, frame.session);
            0
        });
        let robot = self.robot;
        let Sealing { session, key, counter, .. } = &mut self.sessions[at];
        let mut text = frame.payload.clone();
        let both = (robot, *session);
        let (clear, tag) =
            seal_session(key, both, frame.direction, frame.header, *counter, &mut text);
        *counter += 1;
        joined(&clear, &text, &tag)
    }

    fn read(&mut self, contents: &[u8], direction: Direction) -> Result<Frame, Unreadable> {
        if !is_sealed(contents) {
            return Err(Unreadable::Seal);
        }
        let (header, _) = Header::decode(contents).ok_or(Unreadable::Header)?;
        let read = match (header.kind, direction) {
            (FrameKind::Handshake, Direction::ToServer) => self.read_hello(contents),
            (FrameKind::Handshake, Direction::ToRobot) => self.read_answer(contents),
            _ => self.read_session(contents, direction),
        };
        let (session, payload) = read.ok_or(Unreadable::Seal)?;
        Ok(Frame { session, direction, header, payload })
    }

    fn read_hello(&mut self, contents: &[u8]) -> Option<(SessionId, Vec<u8>)> {
        let (clear, rest) = contents.split_first_chunk::<HELLO_CLEAR_LEN>()?;
        let (sealed, tag) = rest.split_last_chunk::<TAG_LEN>()?;
        let [_, _, robot @ .., _, _, _, _, _, _, _, _, _, _, _, _] = *clear;
        let (_, stamp) = clear.split_last_chunk::<12>()?;
        let (boot, clock) = stamp.split_first_chunk::<4>()?;
        let attempt = Attempt {
            boot: u32::from_le_bytes(*boot),
            clock: u64::from_le_bytes(clock.try_into().ok()?),
        };
        let robot = RobotId(u16::from_le_bytes(robot));
        let key = *self.keys.get(&robot)?;
        let mut text = sealed.to_vec();
        if !open_hello(&key, robot, attempt, clear, (&mut text, tag)) {
            return None;
        }
        self.robot = robot;
        self.attempt = attempt;
        let hello = first::<ToServer, Hello>(&text)?;
        self.attempts.insert(hello.nonce, attempt);
        Some((SessionId::NONE, text))
    }

    fn read_answer(&mut self, contents: &[u8]) -> Option<(SessionId, Vec<u8>)> {
        let (clear, rest) = contents.split_first_chunk::<ANSWER_CLEAR_LEN>()?;
        let (sealed, tag) = rest.split_last_chunk::<TAG_LEN>()?;
        let (_, salt) = clear.split_last_chunk::<8>()?;
        let (salt, key) = (u64::from_le_bytes(*salt), self.key()?);
        let attempts = self.attempts.values().rev().copied().map(Some).chain([None]);
        let (attempt, text) = attempts.into_iter().find_map(|attempt| {
            let mut text = sealed.to_vec();
            let opened = open_answer(&key, self.robot, salt, attempt, clear, (&mut text, tag));
            opened.then_some((attempt, text))
        })?;
        self.salt = salt;
        if let (Some(attempt), Some(welcome)) = (attempt, first::<ToRobot, Welcome>(&text))
            && !self.sessions.iter().any(|it| it.session == welcome.session)
        {
            self.begin(&key, attempt, salt, welcome.session);
        }
        Some((SessionId::NONE, text))
    }

    fn read_session(
        &mut self,
        contents: &[u8],
        direction: Direction,
    ) -> Option<(SessionId, Vec<u8>)> {
        let (clear, rest) = contents.split_first_chunk::<SESSION_CLEAR_LEN>()?;
        let (sealed, tag) = rest.split_last_chunk::<TAG_LEN>()?;
        let [.., low, high] = *clear;
        let low = u16::from_le_bytes([low, high]);
        let robot = self.robot;
        let opened = self.sessions.iter_mut().find_map(|it| {
            // The nearest number to the highest with these low bits.
            let ahead = low.wrapping_sub(it.highest as u16) as i16;
            let counter = it.highest.wrapping_add_signed(ahead.into());
            let mut text = sealed.to_vec();
            let both = (robot, it.session);
            let is_open = open_session(&it.key, both, direction, clear, counter, (&mut text, tag));
            is_open.then(|| {
                it.highest = it.highest.max(counter);
                (it.session, text)
            })
        })?;
        self.echo = echo_of(tag);
        Some(opened)
    }
}

impl Envelope {
    /// The envelope for these keys.
    pub fn new(keys: &Keys) -> Self {
        match keys {
            Keys::None => Self::Open,
            Keys::Of { keys, salt, boot } => Self::Keyed(Box::new(Keyed::new(keys, *salt, *boot))),
        }
    }

    /// The bytes of a frame on the wire. Sealing the same frame twice gives different bytes.
    pub fn wire(&mut self, frame: &Frame) -> Vec<u8> {
        match self {
            Self::Open => frame.wire(),
            // What can't be sealed goes out with a checksum.
            Self::Keyed(keyed) => keyed.wire(frame).unwrap_or_else(|| frame.wire()),
        }
    }

    /// Reads the contents of a frame of the session or outside of it.
    ///
    /// # Errors
    /// [`Unreadable`].
    pub fn read(
        &mut self,
        contents: &[u8],
        direction: Direction,
        session: SessionId,
    ) -> Result<Frame, Unreadable> {
        let sessions = [session].into_iter().filter(|&it| it != SessionId::NONE);
        match self {
            Self::Open => Frame::read(contents, direction, sessions),
            Self::Keyed(keyed) => {
                let frame = keyed.read(contents, direction)?;
                let is_known = frame.session == session || frame.session == SessionId::NONE;
                if is_known { Ok(frame) } else { Err(Unreadable::Seal) }
            }
        }
    }
}

/// The first message of a payload, if it is of this type.
fn first<D: Traffic, B: ubimap_protocol::message::Body<D>>(payload: &[u8]) -> Option<B> {
    ubimap_protocol::message::Messages::<D>::new(payload).next()?.ok()?.decode().ok()
}

fn joined(clear: &[u8], text: &[u8], tag: &[u8]) -> Vec<u8> {
    stuffed(&[clear, text, tag].concat())
}
