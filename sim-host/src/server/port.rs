//! One port and its session.

use ubimap_protocol::{
    frame::{Attempt, Direction, MAX_FRAME, SealSupport, SessionId, SessionKey, Stray, cobs, open},
    link::{Answer, Counters, FrameFault, Received, Verdict, is_of_session},
    message::{Hello, Messages, Reset, ToServer, Welcome, Writer},
    time::{Duration, Instant},
    units::RobotId,
};

use super::{
    command::Command,
    inflow::Inflow,
    keyring::Keyring,
    session::{Link, Session},
    snapshot::Snapshot,
    unread::Unread,
};
use crate::timing::SESSION_SILENT;

/// Minimum interval between Reset messages, which tell a robot that it has no session here.
const RESET_INTERVAL: Duration = Duration::from_millis(200);

/// Maximum number of offered sessions while another session is alive.
const MAX_CANDIDATES: usize = 4;
/// If a session was heard after a candidate was offered, the candidate can replace it only after
/// the session has been silent for this long. Robots report their state every two seconds, so of
/// two robots with the same number behind one port, the one with the live session keeps it.
const TWIN_SILENT: Duration = Duration::from_secs(3);

/// What a port requires of the frames that arrive there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Policy {
    /// Checksums: whoever can write to the wire can pass for any robot. For trusted wires.
    #[default]
    Open,
    /// Frames must be sealed with the key of a robot ([`Server::set_key`](super::Server::set_key)).
    Keyed,
}

/// A serial port or a simulated channel, with at most one robot behind it.
#[derive(Debug)]
pub(super) struct Port {
    policy: Policy,
    link: Link,
    inflow: Inflow,
    session: Option<Session>,
    /// Sessions that were offered while `session` was alive, oldest first.
    candidates: Vec<Candidate>,
    /// Decodes frames for the candidates, in parallel with the link.
    decoder: cobs::Decoder<MAX_FRAME>,
    /// The handshake frame to send.
    answer: Option<PendingAnswer>,
    reset: PendingReset,
    messages: MessageCounters,
    bytes_sent: u64,
}

/// A session that was offered in answer to a Hello. The Hello may be a late or replayed copy; only
/// the first valid frame of the offered session proves that the robot has accepted it.
#[derive(Debug)]
pub(super) struct Candidate {
    id: SessionId,
    /// The negotiated frame size, in bytes.
    frame: u16,
    session: Session,
    offered: Instant,
    /// `None` on an open port.
    seal: Option<SealedOffer>,
}

/// The sealed part of an offer.
#[derive(Debug)]
pub(super) struct SealedOffer {
    /// The attempt that it answers.
    pub(super) attempt: Attempt,
    /// The key of the session.
    pub(super) key: SessionKey,
    /// The frame of the Welcome, for Hellos that repeat this one.
    pub(super) welcome: Vec<u8>,
}

#[derive(Debug)]
enum PendingAnswer {
    Open(Answer),
    /// A frame.
    Sealed(Vec<u8>),
}

/// Counters of the messages received at a port that had no effect.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MessageCounters {
    /// Messages of a kind that this version does not know.
    pub unknown: u32,
    /// Messages that can't be read as their kind, or that break a rule.
    pub malformed: u32,
    /// Tile states in updates that arrived after a newer one.
    pub late: u32,
}

impl MessageCounters {
    fn add(&mut self, unread: Unread) {
        let counter = match unread {
            Unread::Unknown(_) => &mut self.unknown,
            Unread::Malformed { .. } => &mut self.malformed,
        };
        *counter = counter.saturating_add(1);
    }
}

#[derive(Debug, Default)]
struct PendingReset {
    due: bool,
    /// The frame, on a keyed port.
    sealed: Vec<u8>,
    last: Option<Instant>,
}

/// The contents of a received frame.
pub(super) enum Brought<'p> {
    /// Nothing that the caller must handle.
    Nothing,
    /// A frame that was dropped.
    Dropped(FrameFault),
    /// A handshake frame without a Hello that can be read.
    Unread(Unread),
    Hello(Hello),
    /// A Hello that was sealed with the robot's key.
    SealedHello(Attempt, Hello),
    /// What pretends to be a sealed Hello of this robot.
    ForgedHello(RobotId),
    /// A sealed frame that the session here does not open.
    Stray(Stray, FrameFault),
    /// Messages of the session. Call [`Port::taken`] after handling them.
    Messages(&'p mut Session, Messages<'p, ToServer>),
}

impl Port {
    pub(super) fn new(policy: Policy) -> Self {
        Self {
            policy,
            link: match policy {
                Policy::Open => Link::new(),
                Policy::Keyed => Link::sealed(SealSupport::PRESENT),
            },
            inflow: Inflow::default(),
            session: None,
            candidates: Vec::new(),
            decoder: cobs::Decoder::default(),
            answer: None,
            reset: PendingReset::default(),
            messages: MessageCounters::default(),
            bytes_sent: 0,
        }
    }

    /// Returns the received bytes that are within the rate limit, and whether this call is the
    /// first to exceed it.
    pub(super) fn admit<'b>(&mut self, bytes: &'b [u8], now: Instant) -> (&'b [u8], bool) {
        let was_flooded = self.inflow.floods();
        let admitted = self.inflow.admit(bytes.len(), now);
        (bytes.get(..admitted).unwrap_or_default(), !was_flooded && self.inflow.floods())
    }

    /// Decodes a frame from the front of `bytes`, and advances `bytes`. `None` if they are used up.
    pub(super) fn receive(
        &mut self,
        bytes: &mut &[u8],
        keyring: &Keyring,
        now: Instant,
    ) -> Option<Brought<'_>> {
        let Self { link, session, reset, messages: counted, policy, .. } = self;
        Some(match (link.receive(bytes, now)?, session) {
            (Received::Bad(fault), session) => {
                let is_silent = |session: &mut Session| session.silent_for(now) >= SESSION_SILENT;
                // On a keyed port a Reset must name the frame that it answers.
                reset.due |= *policy == Policy::Open && session.as_mut().is_none_or(is_silent);
                Brought::Dropped(fault)
            }
            (Received::Sealed(sealed), _) => {
                let key = keyring.key(sealed.robot());
                match key.and_then(|key| sealed.hello(&key)) {
                    Some((attempt, hello)) => Brought::SealedHello(attempt, hello),
                    None => Brought::ForgedHello(sealed.robot()),
                }
            }
            (Received::Stray(stray, fault), _) => Brought::Stray(stray, fault),
            (Received::Handshake(message), _) => match message.decode() {
                Ok(hello) => Brought::Hello(hello),
                Err(_) => {
                    let unread = Unread::of(message);
                    counted.add(unread);
                    Brought::Unread(unread)
                }
            },
            (Received::Session(messages), Some(session)) => {
                session.hear(now);
                Brought::Messages(session, messages)
            }
            (Received::Session(_), None) => Brought::Nothing,
        })
    }

    /// Call this after handling a frame, with its messages that could not be read, and the number of
    /// its tiles whose state was old.
    pub(super) fn taken(&mut self, unread: &[Unread], late: u32) {
        unread.iter().for_each(|&unread| self.messages.add(unread));
        self.messages.late = self.messages.late.saturating_add(late);
        while let Some(frame) = self.link.poll_acknowledged() {
            if let Some(session) = &mut self.session {
                session.acknowledged(frame);
            }
        }
    }

    /// Counts a sealed Hello.
    pub(super) fn judge(&mut self, verdict: Verdict) {
        self.link.judge(verdict);
    }

    /// Returns the candidate that replaces the session: the next frame in `bytes` is a valid frame
    /// of the candidate, and the session has not been heard since the offer, or not for
    /// [`TWIN_SILENT`]. On a keyed port, the newest attempt of a robot replaces its session at once:
    /// the frame proves that the robot has begun it. Call it before [`Port::receive`] with the same bytes.
    pub(super) fn poll_candidate(&mut self, mut bytes: &[u8], now: Instant) -> Option<Candidate> {
        if self.candidates.is_empty() {
            return None;
        }
        let frame = &*self.decoder.next(&mut bytes)?.ok()?;
        let session = self.session.as_ref();
        let is_free = |candidate: &Candidate| {
            session.is_none_or(|session| {
                let silent = session.silent_for(now);
                let is_same = session.robot() == candidate.session.robot();
                candidate.seal.is_some() && is_same
                    || silent > now.since(candidate.offered)
                    || silent >= TWIN_SILENT
            })
        };
        let is_heard = |candidate: &Candidate| {
            let is_good = match &candidate.seal {
                None => open(candidate.id, Direction::ToServer, frame).is_some(),
                Some(seal) => {
                    let keys = (candidate.session.robot(), seal.key);
                    is_of_session::<ToServer>(frame, candidate.id, keys)
                }
            };
            is_good && is_free(candidate)
        };
        let index = self.candidates.iter().position(is_heard)?;
        Some(self.candidates.swap_remove(index))
    }

    /// The session that began or was offered in answer to this Hello.
    pub(super) fn session_of(&self, hello: &Hello) -> Option<(SessionId, &Session)> {
        let session = self.session.as_ref().map(|session| (self.link.session(), session));
        let candidates = self.candidates.iter().map(|it| (it.id, &it.session));
        session.into_iter().chain(candidates).find(|(_, session)| session.answers(hello))
    }

    /// Whether there is a session that began, or was last heard, less than [`SESSION_SILENT`] ago.
    pub(super) fn is_alive(&self, now: Instant) -> bool {
        self.session.as_ref().is_some_and(|session| session.silent_for(now) < SESSION_SILENT)
    }

    /// Adds an offered session while another one is alive. If there are too many, the oldest offer
    /// is withdrawn.
    pub(super) fn offer(&mut self, candidate: Candidate) {
        if self.candidates.is_empty() {
            self.decoder = cobs::Decoder::default();
        }
        if self.candidates.len() >= MAX_CANDIDATES {
            self.candidates.remove(0);
        }
        self.candidates.push(candidate);
    }

    /// The Welcome of the offer that was made for this attempt.
    pub(super) fn welcome_of(&self, robot: RobotId, attempt: Attempt) -> Option<&[u8]> {
        let offers = self.candidates.iter().filter(|offer| offer.session.robot() == robot);
        let mut sealed = offers.filter_map(|offer| offer.seal.as_ref());
        sealed.find(|seal| seal.attempt == attempt).map(|seal| &*seal.welcome)
    }

    /// Withdraws the offers made to a robot.
    pub(super) fn withdraw(&mut self, robot: RobotId) {
        self.candidates.retain(|offer| offer.session.robot() != robot);
    }

    /// Starts an offered session.
    pub(super) fn begin(&mut self, Candidate { id, frame, session, seal, .. }: Candidate) {
        self.candidates.clear();
        let frame = usize::from(frame);
        match seal {
            None => self.link.begin(id, frame),
            Some(seal) => self.link.begin_sealed(id, frame, (session.robot(), seal.key)),
        }
        // A pending Reset refers to the previous session.
        self.reset.due = false;
        self.session = Some(session);
    }

    /// Ends the session, and withdraws all offers.
    pub(super) fn end(&mut self) -> Option<Session> {
        self.candidates.clear();
        self.link.end();
        self.session.take()
    }

    /// Queues the answer to a Hello.
    pub(super) fn answer(&mut self, answer: Answer) {
        self.answer = Some(PendingAnswer::Open(answer));
    }

    /// Queues the sealed frame of the answer to a Hello.
    pub(super) fn answer_sealed(&mut self, frame: Vec<u8>) {
        self.answer = Some(PendingAnswer::Sealed(frame));
    }

    /// Queues the sealed frame of a Reset, in place of an earlier one.
    pub(super) fn reset_sealed(&mut self, frame: Vec<u8>) {
        (self.reset.due, self.reset.sealed) = (true, frame);
    }

    pub(super) fn policy(&self) -> Policy {
        self.policy
    }

    /// Whether the session has used up its counters and must end.
    pub(super) fn is_spent(&self) -> bool {
        self.link.is_spent()
    }

    pub(super) fn session(&self) -> Option<&Session> {
        self.session.as_ref()
    }

    pub(super) fn session_id(&self) -> Option<SessionId> {
        self.session.as_ref().map(|_| self.link.session())
    }

    pub(super) fn session_mut(&mut self) -> Option<&mut Session> {
        self.session.as_mut()
    }

    /// The robot of the session.
    pub(super) fn robot(&self) -> Option<RobotId> {
        self.session().map(Session::robot)
    }

    /// Whether a command fits the frame size negotiated with the robot.
    pub(super) fn has_room_for(&self, command: &Command) -> bool {
        let mut buffer = vec![0; MAX_FRAME];
        let mut writer = Writer::new(&mut buffer);
        command.write(&mut writer) && writer.len() <= self.link.room()
    }

    /// Writes the next due frame. Returns its length.
    pub(super) fn poll_transmit(
        &mut self,
        snapshot: &Snapshot<'_>,
        now: Instant,
        out: &mut [u8],
    ) -> Option<usize> {
        let len =
            self.poll_handshake(now, out).or_else(|| self.poll_session(snapshot, now, out))?;
        self.bytes_sent += len as u64;
        Some(len)
    }

    fn poll_handshake(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        match self.answer.take() {
            Some(PendingAnswer::Open(Answer::Welcome(welcome))) => {
                return self.link.handshake(&welcome, out);
            }
            Some(PendingAnswer::Open(Answer::Refusal(refusal))) => {
                return self.link.handshake(&refusal, out);
            }
            Some(PendingAnswer::Sealed(frame)) => return self.write_sealed(&frame, out),
            None => {}
        }
        if !self.reset.due || self.reset.ready_at() > now {
            return None;
        }
        let sealed = std::mem::take(&mut self.reset.sealed);
        self.reset = PendingReset { due: false, sealed: Vec::new(), last: Some(now) };
        match self.policy {
            Policy::Open => self.link.handshake(&Reset, out),
            Policy::Keyed => self.write_sealed(&sealed, out),
        }
    }

    fn write_sealed(&mut self, frame: &[u8], out: &mut [u8]) -> Option<usize> {
        out.get_mut(..frame.len())?.copy_from_slice(frame);
        self.link.count_sent();
        Some(frame.len())
    }

    fn poll_session(
        &mut self,
        snapshot: &Snapshot<'_>,
        now: Instant,
        out: &mut [u8],
    ) -> Option<usize> {
        let session = self.session.as_mut()?;
        let urgent = session.is_urgent(now);
        let sent = self.link.poll_transmit(now, out, urgent, |writer, reliable| {
            session.fill(snapshot, now, writer, reliable)
        })?;
        session.sent(sent.len, now);
        Some(sent.len)
    }

    /// When the next frame is due.
    pub(super) fn poll_timeout(&self, snapshot: &Snapshot<'_>, now: Instant) -> Option<Instant> {
        if self.answer.is_some() {
            return Some(now);
        }
        let reset = self.reset.due.then(|| self.reset.ready_at());
        let reliable = self.link.can_send_reliable();
        let session = self.session();
        let messages = session.and_then(|session| session.poll_timeout(snapshot, reliable, now));
        [reset, self.link.poll_timeout(), messages].into_iter().flatten().min()
    }

    /// Bytes sent, including framing and retransmissions.
    pub(super) fn bytes_sent(&self) -> u64 {
        self.bytes_sent
    }

    /// Counters of the link.
    pub(super) fn counters(&self) -> Counters {
        self.link.counters()
    }

    /// Counters of the messages.
    pub(super) fn message_counters(&self) -> MessageCounters {
        self.messages
    }
}

impl Candidate {
    /// An offer made at `now`.
    pub(super) fn new(welcome: &Welcome, session: Session, now: Instant) -> Self {
        Self { id: welcome.session, frame: welcome.frame, session, offered: now, seal: None }
    }

    /// This offer on a keyed port.
    pub(super) fn sealed(self, seal: SealedOffer) -> Self {
        Self { seal: Some(seal), ..self }
    }

    /// The attempt that it answers, on a keyed port.
    pub(super) fn attempt(&self) -> Option<Attempt> {
        self.seal.as_ref().map(|seal| seal.attempt)
    }

    /// The session that is offered.
    pub(super) fn session_mut(&mut self) -> &mut Session {
        &mut self.session
    }
}

impl PendingReset {
    fn ready_at(&self) -> Instant {
        self.last.map_or(Instant(0), |last| last + RESET_INTERVAL)
    }
}
