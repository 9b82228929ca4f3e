//! An open peer behind a gate that seals its link, and that may have one fault.

use std::{collections::VecDeque, fmt};

use ubimap_protocol::{
    frame::{
        Attempt, Direction, FrameKind, HELLO_CLEAR_LEN, Header, SESSION_CLEAR_LEN, SessionId,
        TAG_LEN, echo_of, is_sealed,
    },
    message::{Hello, Message, Reset, SealedReset, ToRobot, ToServer, Welcome},
    time::Instant,
};
use ubimap_sim_host::conformance::{Envelope, Frame, Keys, Note, unstuffed};

use super::{KEY, spoiled::edit, virtual_bench::Peer};

/// The number of a robot's last frames that a Reset may name.
const ECHOES: usize = 4;
/// By how many frames a frame may be overtaken.
const WINDOW: u16 = 64;

/// What a gate does wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leak {
    /// Nothing.
    None,
    /// It takes frames of a session with a checksum.
    Checksums,
    /// It takes a sealed frame again.
    Replays,
    /// It takes frames that many others have overtaken.
    WideWindow,
    /// It drops frames that a few others have overtaken.
    NarrowWindow,
    /// It takes Hellos and Welcomes of earlier attempts.
    OldAttempts,
    /// It takes handshakes with a checksum.
    OpenHandshakes,
    /// It takes a Reset whatever frame it names.
    AnyReset,
}

/// A peer behind a gate.
pub struct Gate<P> {
    peer: P,
    to_peer: Direction,
    leak: Leak,
    envelope: Envelope,
    /// The newest session, and those before.
    sessions: Vec<SessionId>,
    /// The highest counter of each session's frames to the peer, and which of the `WINDOW` before it came.
    counters: Vec<(SessionId, u16, u64)>,
    newest: Option<Attempt>,
    /// The nonce of the peer's last Hello.
    nonce: u32,
    echoes: VecDeque<u64>,
}

impl<P: Peer> fmt::Debug for Gate<P> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Gate({:?})", self.leak)
    }
}

impl<P: Peer> Gate<P> {
    /// A gate with the key of the peers.
    pub fn new(peer: P, to_peer: Direction, leak: Leak) -> Self {
        let keys = Keys::Of { keys: vec![KEY], salt: 1 << 41, boot: 3 };
        Self {
            peer,
            to_peer,
            leak,
            envelope: Envelope::new(&keys),
            sessions: Vec::new(),
            counters: Vec::new(),
            newest: None,
            nonce: 0,
            echoes: VecDeque::new(),
        }
    }

    /// A sealed frame for the peer; `None` if it has no effect.
    fn open(&mut self, contents: &[u8]) -> Option<Frame> {
        if !is_sealed(contents) {
            let frame = Frame::read(contents, self.to_peer, self.sessions.iter().copied()).ok()?;
            let wanted = match frame.header.kind {
                FrameKind::Handshake => Leak::OpenHandshakes,
                _ => Leak::Checksums,
            };
            return (self.leak == wanted).then_some(frame);
        }
        let (header, _) = Header::decode(contents)?;
        let newest = self.sessions.first().copied().unwrap_or(SessionId::NONE);
        let mut sessions = self.sessions.clone().into_iter().chain([newest]);
        let frame = sessions
            .find_map(|session| self.envelope.read(contents, self.to_peer, session).ok())?;
        match (header.kind, self.to_peer) {
            (FrameKind::Handshake, Direction::ToServer) => {
                let (clear, _) = contents.split_first_chunk::<HELLO_CLEAR_LEN>()?;
                let (_, stamp) = clear.split_last_chunk::<12>()?;
                let (boot, clock) = stamp.split_first_chunk::<4>()?;
                let attempt = Attempt {
                    boot: u32::from_le_bytes(*boot),
                    clock: u64::from_le_bytes(clock.try_into().ok()?),
                };
                let is_old = self.newest.is_some_and(|newest| attempt < newest);
                if is_old && self.leak != Leak::OldAttempts {
                    return None;
                }
                self.newest = self.newest.max(Some(attempt));
                Some(frame)
            }
            (FrameKind::Handshake, Direction::ToRobot) => self.answer(frame),
            _ => self.is_fresh(frame.session, contents).then_some(frame),
        }
    }

    /// An answer to the robot behind the gate.
    fn answer(&mut self, frame: Frame) -> Option<Frame> {
        let note = frame.notes().0.into_iter().next()?;
        let message = Message::<ToRobot>::new(note.number, &note.body);
        if let Ok(SealedReset { echo }) = message.decode() {
            let is_named = self.echoes.contains(&echo) || self.leak == Leak::AnyReset;
            let note = Note::new::<ToRobot, _>(&Reset);
            let kind = (FrameKind::Handshake, 0);
            return is_named.then(|| Frame::new(SessionId::NONE, self.to_peer, kind, &[note]));
        }
        if self.leak != Leak::OldAttempts {
            return Some(frame);
        }
        let nonce = self.nonce;
        Some(edit::<ToRobot, Welcome>(frame, |welcome| welcome.nonce = nonce))
    }

    /// Whether a frame of a session is new, by the window of its counters.
    fn is_fresh(&mut self, session: SessionId, contents: &[u8]) -> bool {
        let Some((clear, _)) = contents.split_first_chunk::<SESSION_CLEAR_LEN>() else {
            return false;
        };
        let [.., low, high] = *clear;
        let counter = u16::from_le_bytes([low, high]);
        let at = self.counters.iter().position(|it| it.0 == session);
        let at = at.unwrap_or_else(|| {
            self.counters.push((session, counter.wrapping_sub(1), 0));
            self.counters.len() - 1
        });
        let (_, highest, came) = &mut self.counters[at];
        let ahead = counter.wrapping_sub(*highest) as i16;
        if ahead > 0 {
            *came = came.checked_shl(ahead as u32).unwrap_or(0) | 1;
            *highest = counter;
            return true;
        }
        let behind = ahead.unsigned_abs();
        let bit = 1_u64.checked_shl(behind.into()).unwrap_or(0);
        let is_new = *came & bit == 0;
        *came |= bit;
        match self.leak {
            Leak::Replays => behind < WINDOW,
            Leak::WideWindow => is_new,
            Leak::NarrowWindow => is_new && behind < 32,
            _ => is_new && behind < WINDOW,
        }
    }

    /// A frame of the peer as it goes out.
    fn seal(&mut self, frame: &Frame) -> Vec<u8> {
        for note in frame.notes().0 {
            if let Ok(hello) = Message::<ToServer>::new(note.number, &note.body).decode::<Hello>()
                && frame.direction == Direction::ToServer
            {
                self.nonce = hello.nonce;
            }
        }
        let wire = self.envelope.wire(frame);
        if let Some(tag) =
            unstuffed(&wire).ok().as_deref().and_then(|it| it.last_chunk::<TAG_LEN>())
            && frame.session != SessionId::NONE
        {
            self.echoes.push_back(echo_of(tag));
            self.echoes.drain(..self.echoes.len().saturating_sub(ECHOES));
        }
        wire
    }

    /// Learns the session of a Welcome.
    fn learn(&mut self, frame: &Frame) {
        if frame.direction != Direction::ToRobot {
            return;
        }
        for note in frame.notes().0 {
            let message = Message::<ToRobot>::new(note.number, &note.body);
            if let Ok(Welcome { session, .. }) = message.decode()
                && !self.sessions.contains(&session)
            {
                self.sessions.insert(0, session);
                self.sessions.truncate(6);
            }
        }
    }
}

impl<P: Peer> Peer for Gate<P> {
    fn receive(&mut self, bytes: &[u8], now: Instant) {
        let opened = unstuffed(bytes).ok().and_then(|contents| self.open(&contents));
        if let Some(frame) = opened {
            self.learn(&frame);
            self.peer.receive(&frame.wire(), now);
        }
    }

    fn poll_transmit(&mut self, now: Instant) -> Option<Vec<u8>> {
        let from_peer = match self.to_peer {
            Direction::ToRobot => Direction::ToServer,
            Direction::ToServer => Direction::ToRobot,
        };
        let wire = self.peer.poll_transmit(now)?;
        let contents = unstuffed(&wire).ok()?;
        let frame = Frame::read(&contents, from_peer, self.sessions.iter().copied()).ok()?;
        self.learn(&frame);
        Some(self.seal(&frame))
    }

    fn poll_timeout(&self, now: Instant) -> Option<Instant> {
        self.peer.poll_timeout(now)
    }

    fn timeout(&mut self, now: Instant) {
        self.peer.timeout(now);
    }
}
