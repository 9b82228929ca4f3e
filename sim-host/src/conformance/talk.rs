//! The runner's side of a link. It follows the protocol unless a check tells it not to.

use std::{collections::VecDeque, rc::Rc};

use ubimap_protocol::{
    frame::{
        Direction, FrameKind, MAX_SEALED_HANDSHAKE, MIN_FRAME, MIN_SEALED_FRAME, SEQUENCE_MODULUS,
        SessionId, cobs::DELIMITER,
    },
    message::{
        Ack, Body, Message, TimeReply, TimeRequest, ToRobot, ToRobotKind, ToServer, ToServerKind,
        Traffic,
    },
    time::{Duration, Instant},
};

use super::{
    bench::Bench,
    describe::Describer,
    envelope::Envelope,
    followed::Carrier,
    frames::{Frame, Note, Unreadable, unstuffed},
    halt::{Halt, Role, fail},
    sides::{RobotSide, ServerSide},
};

/// Number of frames that a failure shows.
const SHOWN: usize = 12;

/// A frame from the implementation under test.
#[derive(Clone, Debug)]
pub(super) struct Seen {
    pub(super) at: Instant,
    pub(super) wire: Vec<u8>,
    pub(super) frame: Result<Frame, Unreadable>,
    pub(super) notes: Vec<Note>,
    /// Whether its payload ends within a message.
    pub(super) is_cut: bool,
}

impl Seen {
    pub(super) fn kind(&self) -> Option<FrameKind> {
        Some(self.frame.as_ref().ok()?.header.kind)
    }

    /// The sequence number of a reliable frame.
    pub(super) fn reliable(&self) -> Option<u16> {
        let header = self.frame.as_ref().ok()?.header;
        (header.kind == FrameKind::Reliable).then_some(header.sequence)
    }

    /// The frame for what is kept of it; `None` if it can't be read.
    pub(super) fn carrier(&self) -> Option<Rc<Carrier>> {
        let frame = self.frame.clone().ok()?;
        Some(Rc::new(Carrier { at: self.at, wire: self.wire.clone(), frame }))
    }

    /// Its messages with this body.
    pub(super) fn bodies<D: Traffic, B: Body<D>>(&self) -> impl Iterator<Item = B> {
        self.notes.iter().filter_map(|it| Message::<D>::new(it.number, &it.body).decode().ok())
    }
}

/// The runner's receive window, kept as SPEC 3.1 says.
#[derive(Clone, Copy, Debug, Default)]
struct Window {
    next: u16,
    later: u32,
}

impl Window {
    /// Takes a frame; returns whether it is new.
    fn take(&mut self, sequence: u16) -> bool {
        let before = *self;
        match ahead(sequence, self.next) {
            0 => {
                self.next = (self.next + 1) % SEQUENCE_MODULUS;
                while self.later & 1 == 1 {
                    self.later >>= 1;
                    self.next = (self.next + 1) % SEQUENCE_MODULUS;
                }
                self.later >>= 1;
            }
            k @ 1..=32 => self.later |= 1 << (k - 1),
            _ => {}
        }
        self.next != before.next || self.later != before.later
    }
}

/// By how much `a` is ahead of `b`.
pub(super) fn ahead(a: u16, b: u16) -> u16 {
    (a + SEQUENCE_MODULUS - b % SEQUENCE_MODULUS) % SEQUENCE_MODULUS
}

/// Whether an acknowledgement covers a sequence number.
pub(super) fn covers(ack: Ack, sequence: u16) -> bool {
    match ahead(sequence, ack.next) {
        1024.. => true,
        k @ 1..=32 => ack.later >> (k - 1) & 1 == 1,
        _ => false,
    }
}

/// A conversation with the implementation under test.
pub struct Talk<'b> {
    bench: &'b mut dyn Bench,
    pub(super) role: Role,
    pub(super) session: SessionId,
    reliable: u16,
    datagrams: u16,
    window: Window,
    /// Whether reliable frames are acknowledged and time requests are answered.
    pub(super) is_polite: bool,
    /// Whether it answers time requests alone, and acknowledges nothing.
    pub(super) withholds: bool,
    partial: Vec<u8>,
    arrived: VecDeque<Seen>,
    /// The reliable frames of the session so far.
    pub(super) sequences: Vec<u16>,
    /// The acknowledgements of the session so far, with their times.
    pub(super) acks: Vec<(Instant, Ack)>,
    log: VecDeque<(Instant, Direction, Vec<u8>, Option<Frame>)>,
    /// The frame that breaks the rule, if the check knows it.
    at_fault: Option<Rc<Carrier>>,
    envelope: Envelope,
    sessions: Vec<SessionId>,
    /// Number of questions asked.
    pub(super) asked: u16,
    pub(super) server: ServerSide,
    pub(super) robot: RobotSide,
}

impl<'b> Talk<'b> {
    /// A conversation that begins.
    pub(super) fn new(bench: &'b mut dyn Bench, role: Role, envelope: Envelope) -> Self {
        let mut robot = RobotSide::default();
        if let Envelope::Keyed(keyed) = &envelope {
            robot.robot = keyed.robot();
        }
        Self {
            bench,
            role,
            session: SessionId::NONE,
            reliable: 0,
            datagrams: 0,
            window: Window::default(),
            is_polite: true,
            withholds: false,
            partial: Vec::new(),
            arrived: VecDeque::new(),
            sequences: Vec::new(),
            acks: Vec::new(),
            log: VecDeque::new(),
            at_fault: None,
            envelope,
            sessions: Vec::new(),
            asked: 0,
            server: ServerSide::default(),
            robot,
        }
    }

    /// Prepares for the next check.
    pub(super) fn rest(&mut self) {
        self.log.clear();
        self.at_fault = None;
        self.arrived.clear();
        self.is_polite = true;
        self.withholds = false;
    }

    /// A failed check whose fault is in this frame.
    pub(super) fn fail_in<T>(
        &mut self,
        carrier: &Rc<Carrier>,
        expected: impl Into<String>,
        found: impl Into<String>,
    ) -> Result<T, Halt> {
        self.at_fault = Some(Rc::clone(carrier));
        fail(expected, found)
    }

    /// The last frames as text, after the one at fault if it is known.
    pub(super) fn shown(&self) -> Vec<String> {
        let mut lines = Vec::new();
        if let Some(Carrier { at, wire, frame }) = self.at_fault.as_deref() {
            lines.push("the frame at fault:".to_owned());
            lines.extend(self.told(*at, self.inwards(), wire, Some(frame)));
            lines.push("the last frames:".to_owned());
        }
        let newest = self.log.iter().skip(self.log.len().saturating_sub(SHOWN));
        for (at, direction, wire, frame) in newest {
            lines.extend(self.told(*at, *direction, wire, frame.as_ref()));
        }
        lines
    }

    /// A frame in words, and its bytes.
    fn told(
        &self,
        at: Instant,
        direction: Direction,
        wire: &[u8],
        frame: Option<&Frame>,
    ) -> [String; 2] {
        let mut describer = Describer::new(None, Some(direction));
        self.sessions.iter().for_each(|&session| describer.know(session));
        let sent = if direction == self.outwards() { "sent" } else { "got" };
        let text = match frame {
            Some(frame) => describer.read_frame(wire.len(), frame),
            None => describer.frame(wire),
        };
        [
            format!("{:>9.3} s {sent:>4} {text}", at.micros() as f64 / 1e6),
            format!("{:>16} {}", "", super::describe::hex(wire)),
        ]
    }

    pub(super) fn now(&self) -> Instant {
        self.bench.now()
    }

    pub(super) fn slack(&self) -> Duration {
        self.bench.slack()
    }

    /// How long the runner waits for something that a peer should do at once.
    pub(super) fn patience(&self) -> Duration {
        Duration::from_millis(400) + self.slack() + self.slack()
    }

    /// The direction of the runner's frames.
    pub(super) fn outwards(&self) -> Direction {
        match self.role {
            Role::Robot => Direction::ToRobot,
            Role::Server => Direction::ToServer,
        }
    }

    /// The direction of the peer's frames.
    pub(super) fn inwards(&self) -> Direction {
        match self.role {
            Role::Robot => Direction::ToServer,
            Role::Server => Direction::ToRobot,
        }
    }

    /// Begins a session on the runner's side.
    pub(super) fn begin(&mut self, session: SessionId) {
        self.session = session;
        self.sessions.push(session);
        self.reliable = 0;
        self.datagrams = 0;
        self.window = Window::default();
        self.acks.clear();
        self.sequences.clear();
    }
}

/// Sending.
impl Talk<'_> {
    /// Sends bytes as they are.
    pub(super) fn send_wire(&mut self, wire: Vec<u8>) -> Result<(), Halt> {
        self.bench.send(&wire)?;
        self.remember(self.outwards(), wire, None);
        Ok(())
    }

    fn remember(&mut self, direction: Direction, wire: Vec<u8>, frame: Option<Frame>) {
        if self.log.len() > 4 * SHOWN {
            self.log.pop_front();
        }
        self.log.push_back((self.bench.now(), direction, wire, frame));
    }

    pub(super) fn send(&mut self, frame: &Frame) -> Result<(), Halt> {
        let wire = self.wire(frame);
        self.bench.send(&wire)?;
        self.remember(self.outwards(), wire, Some(frame.clone()));
        Ok(())
    }

    /// The bytes of a frame on the wire.
    pub(super) fn wire(&mut self, frame: &Frame) -> Vec<u8> {
        self.envelope.wire(frame)
    }

    /// Whether frames are sealed with keys.
    pub(super) fn is_keyed(&self) -> bool {
        matches!(self.envelope, Envelope::Keyed(_))
    }

    /// The smallest frame that may be agreed on.
    pub(super) fn min_frame(&self) -> u16 {
        if self.is_keyed() { MIN_SEALED_FRAME as u16 } else { MIN_FRAME as u16 }
    }

    /// The longest frame of the handshake.
    pub(super) fn max_handshake(&self) -> usize {
        if self.is_keyed() { MAX_SEALED_HANDSHAKE } else { 36 }
    }

    /// Lets the next Reset name no frame.
    pub(super) fn forget_echo(&mut self) {
        if let Envelope::Keyed(keyed) = &mut self.envelope {
            keyed.echo ^= 1;
        }
    }

    /// Another boot of the runner as a robot.
    pub(super) fn count_boot(&mut self) {
        if let Envelope::Keyed(keyed) = &mut self.envelope {
            keyed.attempt.boot += 1;
        }
    }

    /// A frame of the session.
    pub(super) fn frame(&self, kind: FrameKind, sequence: u16, notes: &[Note]) -> Frame {
        Frame::new(self.session, self.outwards(), (kind, sequence), notes)
    }

    /// Sends messages outside any session.
    pub(super) fn handshake(&mut self, note: Note) -> Result<(), Halt> {
        let frame = self.outside(note);
        self.send(&frame)
    }

    /// A frame outside any session.
    pub(super) fn outside(&self, note: Note) -> Frame {
        let to = self.outwards();
        Frame::new(SessionId::NONE, to, (FrameKind::Handshake, 0), &[note])
    }

    /// Sends messages in a datagram.
    pub(super) fn datagram(&mut self, notes: &[Note]) -> Result<(), Halt> {
        let frame = self.frame(FrameKind::Datagram, self.datagrams, notes);
        self.datagrams = (self.datagrams + 1) % SEQUENCE_MODULUS;
        self.send(&frame)
    }

    /// The next reliable frame with these messages, which is not sent yet.
    pub(super) fn next_reliable(&mut self, notes: &[Note]) -> Frame {
        let frame = self.frame(FrameKind::Reliable, self.reliable, notes);
        self.reliable = (self.reliable + 1) % SEQUENCE_MODULUS;
        frame
    }

    /// Sends messages in a reliable frame, once. Returns its sequence number.
    pub(super) fn reliable(&mut self, notes: &[Note]) -> Result<u16, Halt> {
        let frame = self.next_reliable(notes);
        self.send(&frame)?;
        Ok(frame.header.sequence)
    }

    /// Sends messages in a reliable frame until it is acknowledged, and fails if it is not.
    pub(super) fn deliver(&mut self, notes: &[Note]) -> Result<(), Halt> {
        let frame = self.next_reliable(notes);
        for _ in 0..5 {
            self.send(&frame)?;
            if self.is_acknowledged(frame.header.sequence)? {
                return Ok(());
            }
        }
        fail(
            "3.1: a reliable frame is acknowledged",
            format!("frame {} was not", frame.header.sequence),
        )
    }

    /// The sequence number of the next reliable frame.
    pub(super) fn next_sequence(&self) -> u16 {
        self.reliable
    }

    pub(super) fn set_next_sequence(&mut self, sequence: u16) {
        self.reliable = sequence % SEQUENCE_MODULUS;
    }

    /// Acknowledges what has arrived.
    pub(super) fn acknowledge(&mut self) -> Result<(), Halt> {
        let ack = Ack { next: self.window.next, later: self.window.later };
        self.acknowledge_as(ack)
    }

    pub(super) fn acknowledge_as(&mut self, ack: Ack) -> Result<(), Halt> {
        let note = Note::new::<ToServer, _>(&ack);
        self.datagram(&[note])
    }
}

/// Receiving.
impl Talk<'_> {
    /// The next frame from the peer, if one comes before `until`.
    pub(super) fn next(&mut self, until: Instant) -> Result<Option<Seen>, Halt> {
        loop {
            if let Some(seen) = self.arrived.pop_front() {
                return Ok(Some(seen));
            }
            if self.bench.now() >= until {
                return Ok(None);
            }
            let bytes = self.bench.receive(until)?;
            for byte in bytes {
                self.partial.push(byte);
                if byte == DELIMITER {
                    let wire = std::mem::take(&mut self.partial);
                    if wire.len() > 1 {
                        self.arrive(wire)?;
                    }
                }
            }
        }
    }

    fn arrive(&mut self, wire: Vec<u8>) -> Result<(), Halt> {
        let at = self.bench.now();
        let (inwards, session) = (self.inwards(), self.session);
        let frame = unstuffed(&wire).map_err(Unreadable::Stuffing);
        let frame = frame.and_then(|it| self.envelope.read(&it, inwards, session));
        self.remember(inwards, wire.clone(), frame.clone().ok());
        let (notes, is_cut) = frame.as_ref().map(Frame::notes).unwrap_or_default();
        let seen = Seen { at, wire, frame, notes, is_cut };
        let is_of_session = seen.frame.as_ref().is_ok_and(|it| it.session != SessionId::NONE);
        let mut is_new = true;
        if is_of_session {
            let acks: Vec<Ack> = match self.role {
                Role::Robot => seen.bodies::<ToServer, Ack>().collect(),
                Role::Server => seen.bodies::<ToRobot, Ack>().collect(),
            };
            self.acks.extend(acks.into_iter().map(|ack| (at, ack)));
            if let Some(sequence) = seen.reliable() {
                is_new = self.window.take(sequence);
                self.sequences.push(sequence);
            }
            if self.is_polite {
                self.answer(&seen)?;
            }
        }
        if is_new {
            self.follow(&seen);
        }
        self.arrived.push_back(seen);
        Ok(())
    }

    /// Acknowledges a frame, and answers its time requests.
    fn answer(&mut self, seen: &Seen) -> Result<(), Halt> {
        let mut notes = Vec::new();
        if seen.reliable().is_some() && !self.withholds {
            let ack = Ack { next: self.window.next, later: self.window.later };
            notes.push(Note::new::<ToServer, _>(&ack));
        }
        if self.role == Role::Robot {
            for TimeRequest { nonce } in seen.bodies::<ToServer, TimeRequest>() {
                let received = self.server.time(seen.at);
                let held_micros = self.now().since(seen.at).micros() as u32;
                notes.push(Note::new::<ToRobot, _>(&TimeReply { nonce, received, held_micros }));
            }
        }
        if notes.is_empty() { Ok(()) } else { self.datagram(&notes) }
    }

    /// Waits for a time, and drops what arrives.
    pub(super) fn wait(&mut self, span: Duration) -> Result<(), Halt> {
        self.collect(span).map(|_| ())
    }

    /// Everything that arrives within a time.
    pub(super) fn collect(&mut self, span: Duration) -> Result<Vec<Seen>, Halt> {
        let until = self.now() + span;
        let mut all = Vec::new();
        while let Some(seen) = self.next(until)? {
            all.push(seen);
        }
        Ok(all)
    }

    /// The first frame for which `is` is true, if it comes within a time. Others before it are dropped.
    pub(super) fn find(
        &mut self,
        span: Duration,
        mut is: impl FnMut(&Self, &Seen) -> bool,
    ) -> Result<Option<Seen>, Halt> {
        let until = self.now() + span;
        while let Some(seen) = self.next(until)? {
            if is(self, &seen) {
                return Ok(Some(seen));
            }
        }
        Ok(None)
    }

    /// The first message of a kind within a time.
    pub(super) fn body<D: Traffic, B: Body<D>>(
        &mut self,
        span: Duration,
    ) -> Result<Option<B>, Halt> {
        let seen = self.find(span, |_, seen| seen.bodies::<D, B>().next().is_some())?;
        Ok(seen.and_then(|seen| seen.bodies::<D, B>().next()))
    }

    /// Whether the peer acknowledges a reliable frame within the patience of the runner. The frames
    /// that arrive meanwhile are kept for the caller.
    pub(super) fn is_acknowledged(&mut self, sequence: u16) -> Result<bool, Halt> {
        let until = self.now() + self.patience();
        let mut kept = Vec::new();
        let mut acknowledged = false;
        loop {
            acknowledged |= self.acks.last().is_some_and(|&(_, ack)| covers(ack, sequence));
            if acknowledged {
                break;
            }
            match self.next(until)? {
                Some(seen) => kept.push(seen),
                None => break,
            }
        }
        for seen in kept.into_iter().rev() {
            self.arrived.push_front(seen);
        }
        Ok(acknowledged)
    }
}

/// Questions that any implementation answers in a reliable frame.
impl Talk<'_> {
    /// A session in which the peer has been heard.
    pub(super) fn open(&mut self) -> Result<(), Halt> {
        match self.role {
            Role::Robot => self.welcome_robot(|_| ()),
            Role::Server => self.join_server(|_| ()),
        }
    }

    /// A question: a robot answers it with a report of its parameters, a server with a request for a
    /// tile whose base it lacks.
    pub(super) fn question(&mut self) -> Note {
        self.asked += 1;
        match self.role {
            Role::Robot => self.parameter_question(),
            Role::Server => self.base_question(),
        }
    }

    /// Whether a frame answers the last question.
    pub(super) fn is_answer(&self, seen: &Seen) -> bool {
        self.answers(seen).contains(&self.asked)
    }

    /// The questions that a frame answers.
    pub(super) fn answers(&self, seen: &Seen) -> Vec<u16> {
        match self.role {
            Role::Robot => self.reported(seen),
            Role::Server => self.requested(seen),
        }
    }

    /// Whether the last question is answered within the patience of the runner.
    pub(super) fn is_answered(&mut self) -> Result<bool, Halt> {
        Ok(self.find(self.patience(), |it, seen| it.is_answer(seen))?.is_some())
    }

    /// Asks in a new reliable frame, and fails if the peer does not answer.
    pub(super) fn must_answer(&mut self, when: &str) -> Result<(), Halt> {
        let question = self.question();
        self.reliable(&[question])?;
        if self.is_answered()? {
            return Ok(());
        }
        fail(format!("{when}: an answer to a good question ({})", self.answer_name()), "none")
    }

    /// Sends a frame with the last question that must have no effect, and fails if it has one.
    pub(super) fn must_ignore(
        &mut self,
        frame: &Frame,
        wire: Vec<u8>,
        what: &str,
    ) -> Result<(), Halt> {
        self.acks.clear();
        self.send_wire(wire)?;
        if self.is_answered()? {
            return fail(format!("{what}: no effect"), "its question was answered");
        }
        let sequence = frame.header.sequence;
        let is_reliable = frame.header.kind == FrameKind::Reliable;
        if is_reliable && self.acks.iter().any(|&(_, ack)| covers(ack, sequence)) {
            return fail(format!("{what}: not acknowledged"), format!("frame {sequence} was"));
        }
        Ok(())
    }

    /// As [`Talk::must_ignore`], with a frame that is sealed first.
    pub(super) fn must_ignore_frame(
        &mut self,
        good: &Frame,
        sent: &Frame,
        what: &str,
    ) -> Result<(), Halt> {
        let wire = self.wire(sent);
        self.must_ignore(good, wire, what)
    }

    fn answer_name(&self) -> String {
        match self.role {
            Role::Robot => format!("kind {}", u8::from(ToServerKind::ParameterReport)),
            Role::Server => format!("kind {}", u8::from(ToRobotKind::Request)),
        }
    }
}
