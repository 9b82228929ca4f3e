//! A good peer with one fault, which sits on the wire before it.

use std::{collections::BTreeMap, fmt};

use ubimap_protocol::{
    frame::{Direction, FrameKind, SessionId},
    message::{Body, Message, ToRobot, Traffic, Welcome},
    time::Instant,
};
use ubimap_sim_host::conformance::{Frame, Note, payload, unstuffed};

use super::virtual_bench::Peer;

/// What a fault may remember.
#[derive(Debug, Default)]
pub struct Context {
    /// The time.
    pub now: Instant,
    /// A number of the fault's own.
    pub number: u32,
    /// The reliable frames that have passed outwards and inwards in this session, by their numbers.
    pub passed: [BTreeMap<u16, u32>; 2],
    /// Frames that leave later.
    pub delayed: Vec<(Instant, Frame)>,
    sessions: Vec<SessionId>,
}

impl Context {
    /// The newest session.
    pub fn session(&self) -> SessionId {
        self.sessions.first().copied().unwrap_or(SessionId::NONE)
    }

    /// How often a reliable frame has passed in its direction before; 0 for others.
    pub fn copies(&self, frame: &Frame) -> u32 {
        let passed = &self.passed[frame.direction as usize];
        match frame.header.kind {
            FrameKind::Reliable => passed.get(&frame.header.sequence).map_or(0, |count| count - 1),
            _ => 0,
        }
    }
}

/// What a peer reads instead of bytes that are no good frame, and the frames that it sends at once.
pub type Reaction = (Option<Vec<u8>>, Vec<Frame>);

/// A fault: what it does to the good frames to and from the peer, and to the bytes that are not a
/// good frame.
#[derive(Clone, Copy)]
pub struct Hooks {
    /// Frames from the runner to the peer.
    pub inwards: fn(&mut Context, Frame) -> Vec<Frame>,
    /// Frames from the peer to the runner.
    pub outwards: fn(&mut Context, Frame) -> Vec<Frame>,
    /// Bytes from the runner that are no good frame: what the peer reads, and what it sends at once.
    pub bad: fn(&mut Context, &[u8], SessionId) -> Reaction,
}

impl fmt::Debug for Hooks {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Hooks")
    }
}

impl Hooks {
    /// No fault.
    pub const NONE: Self = Self {
        inwards: |_, frame| vec![frame],
        outwards: |_, frame| vec![frame],
        bad: |_, wire, _| (Some(wire.to_vec()), Vec::new()),
    };
}

/// A peer with a fault.
#[derive(Debug)]
pub struct Spoiled<P> {
    peer: P,
    hooks: Hooks,
    to_peer: Direction,
    context: Context,
    sent: Vec<Vec<u8>>,
}

impl<P: Peer> Spoiled<P> {
    /// A peer that is spoiled by these hooks. `to_peer` is the direction of what it receives.
    pub fn new(peer: P, to_peer: Direction, hooks: Hooks) -> Self {
        Self { peer, hooks, to_peer, context: Context::default(), sent: Vec::new() }
    }

    fn read(&mut self, wire: &[u8], direction: Direction) -> Option<Frame> {
        let contents = unstuffed(wire).ok()?;
        let frame =
            Frame::read(&contents, direction, self.context.sessions.iter().copied()).ok()?;
        let is_current = self.context.sessions.first() == Some(&frame.session);
        if frame.header.kind == FrameKind::Reliable && is_current {
            let passed = &mut self.context.passed[direction as usize];
            *passed.entry(frame.header.sequence).or_default() += 1;
        }
        Some(frame)
    }

    /// Learns the session of a Welcome.
    fn learn(&mut self, frame: &Frame) {
        let welcomes = frame.notes().0.into_iter().filter_map(|note| {
            Message::<ToRobot>::new(note.number, &note.body).decode::<Welcome>().ok()
        });
        for welcome in welcomes.filter(|_| frame.direction == Direction::ToRobot) {
            if !self.context.sessions.contains(&welcome.session) {
                self.context.sessions.insert(0, welcome.session);
                self.context.sessions.truncate(6);
                self.context.passed = Default::default();
            }
        }
    }
}

impl<P: Peer> Peer for Spoiled<P> {
    fn receive(&mut self, bytes: &[u8], now: Instant) {
        self.context.now = now;
        match self.read(bytes, self.to_peer) {
            Some(frame) => {
                self.learn(&frame);
                for frame in (self.hooks.inwards)(&mut self.context, frame) {
                    self.peer.receive(&frame.wire(), now);
                }
            }
            None => {
                let session = self.context.session();
                let (read, sent) = (self.hooks.bad)(&mut self.context, bytes, session);
                self.sent.extend(sent.iter().map(Frame::wire));
                if let Some(read) = read {
                    self.peer.receive(&read, now);
                }
            }
        }
    }

    fn poll_transmit(&mut self, now: Instant) -> Option<Vec<u8>> {
        self.context.now = now;
        let from_peer = match self.to_peer {
            Direction::ToRobot => Direction::ToServer,
            Direction::ToServer => Direction::ToRobot,
        };
        while let Some(wire) = self.peer.poll_transmit(now) {
            match self.read(&wire, from_peer) {
                Some(frame) => {
                    self.learn(&frame);
                    let frames = (self.hooks.outwards)(&mut self.context, frame);
                    self.sent.extend(frames.iter().map(Frame::wire));
                }
                None => self.sent.push(wire),
            }
        }
        let due = self.context.delayed.extract_if(.., |(at, _)| *at <= now);
        self.sent.extend(due.map(|(_, frame)| frame.wire()));
        (!self.sent.is_empty()).then(|| self.sent.remove(0))
    }

    fn poll_timeout(&self, now: Instant) -> Option<Instant> {
        let delayed = self.context.delayed.iter().map(|(at, _)| *at).min();
        Instant::earlier(self.peer.poll_timeout(now), delayed)
    }

    fn timeout(&mut self, now: Instant) {
        self.peer.timeout(now);
    }
}

/// A frame without its messages of a kind; none if it has no others.
pub fn without(frame: Frame, number: u8) -> Vec<Frame> {
    let (notes, _) = frame.notes();
    let kept: Vec<Note> = notes.iter().filter(|note| note.number != number).cloned().collect();
    if kept.len() == notes.len() {
        return vec![frame];
    }
    let is_empty = kept.is_empty() && frame.header.kind != FrameKind::Reliable;
    let frame = Frame { payload: payload(&kept), ..frame };
    if is_empty { Vec::new() } else { vec![frame] }
}

/// A frame with its messages of a type altered.
pub fn edit<D: Traffic, B: Body<D>>(frame: Frame, mut change: impl FnMut(&mut B)) -> Frame {
    let (notes, is_cut) = frame.notes();
    if is_cut {
        return frame;
    }
    let altered = |note: Note| match Message::<D>::new(note.number, &note.body).decode::<B>() {
        Ok(mut body) => {
            change(&mut body);
            Note::new::<D, B>(&body)
        }
        Err(_) => note,
    };
    let notes: Vec<Note> = notes.into_iter().map(altered).collect();
    Frame { payload: payload(&notes), ..frame }
}
