//! One end of a link: turns bytes into messages and messages into frames.

use core::marker::PhantomData;

use super::{
    acknowledgement::{Arrival, ReceiveWindow, SendWindow},
    fault::FrameFault,
    sealed_handshake::SealedHandshake,
    security::{Opened, Security},
};
use crate::{
    frame::{
        DEFAULT_FRAME, FrameKind, HEADER_LEN, Header, MIN_VERSION, SEAL_LEN, SEQUENCE_MODULUS,
        SealSlot, SealSupport, SessionKey, Stray, VERSION, cobs, seal,
    },
    message::{Ack, Body, Message, Messages, Traffic, Writer},
    time::Instant,
    units::{RobotId, SessionId},
};

/// If a frame has less room for messages than this, an acknowledgement travels alone: beside it the
/// longest message that cannot be split (a state, 28 bytes) might not fit.
const ROOM_FOR_TWO: usize = 40;

// The frames of a session must have the version of its Welcome. With more than one version to speak,
// `Endpoint::begin` would have to be told which.
const _: () = assert!(MIN_VERSION == VERSION);

/// Maximum size of an acknowledgement in bytes, kind and length included.
const ACK_LEN: usize = 10;

/// Counters of an endpoint since its creation; they wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Frames sent, retransmissions included.
    pub sent: u32,
    /// Reliable frames sent again.
    pub retransmissions: u32,
    /// Good frames received, duplicates included.
    pub received: u32,
    /// Reliable frames received more than once.
    pub duplicates: u32,
    /// Frames with wrong stuffing or a wrong length, and without a good seal of either sort.
    pub bad: u32,
    /// Undamaged frames that violate the protocol: a malformed message, a sequence number outside
    /// the window, an unsupported version; on a sealed link, a handshake frame of an open one.
    pub refused: u32,
    /// Sealed frames whose counter or attempt was accepted before, or is too old to tell.
    pub replayed: u32,
    /// Sealed frames with a wrong tag, or with no key here that could open them.
    pub forged: u32,
}

/// How the owner of an endpoint judges a sealed handshake frame, for the counters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The frame is good.
    Good,
    /// Its attempt, salt or echo is an old one.
    Replayed,
    /// Its tag is wrong, or there is no key for it.
    Forged,
    /// It has no complete message, or one that is not allowed.
    Refused,
}

/// What an endpoint received, in direction `D`.
#[derive(Debug)]
pub enum Received<'a, D> {
    /// A message outside any session.
    Handshake(Message<'a, D>),
    /// On a sealed link, a frame outside any session. The owner opens it and reports its
    /// [`Verdict`].
    Sealed(SealedHandshake<'a>),
    /// The messages of a frame of this session; duplicates are left out. Acknowledgements are
    /// included, although the endpoint has already processed them.
    Session(Messages<'a, D>),
    /// On a sealed link, a frame that this session does not open, or a replayed one.
    Stray(Stray, FrameFault),
    /// Not a frame of this session, or one that violates the protocol.
    Bad(FrameFault),
}

/// What the `fill` argument of [`Endpoint::poll_transmit`] has written into a new frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fill<T> {
    /// Nothing to send now.
    Nothing,
    /// Send once.
    Datagram,
    /// Retransmit until acknowledged; then [`Endpoint::poll_acknowledged`] returns the token.
    Reliable(T),
}

/// A frame to put on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transmit<T> {
    /// Its length in bytes.
    pub len: usize,
    /// The token of a reliable frame, `None` for others.
    pub token: Option<T>,
}

/// One end of a link, sending messages of direction `D`. At most `WINDOW` reliable frames (at most
/// 32) of at most `FRAME` bytes on the wire are in flight. `T` is the token by which the owner
/// identifies a reliable frame. Memory: about `(WINDOW + 1) * FRAME` bytes, and `FRAME` bytes of
/// stack while writing a frame.
#[derive(Debug)]
pub struct Endpoint<D, T, const WINDOW: usize, const FRAME: usize> {
    direction: PhantomData<D>,
    security: Security,
    session: SessionId,
    /// Agreed frame size in bytes on the wire.
    frame: usize,
    decoder: cobs::Decoder<FRAME>,
    receiving: ReceiveWindow,
    sending: SendWindow<T, WINDOW, FRAME>,
    datagrams: u16,
    counters: Counters,
}

impl<D: Traffic, T: Copy, const WINDOW: usize, const FRAME: usize> Default
    for Endpoint<D, T, WINDOW, FRAME>
{
    fn default() -> Self {
        Self::new()
    }
}

impl<D: Traffic, T: Copy, const WINDOW: usize, const FRAME: usize> Endpoint<D, T, WINDOW, FRAME> {
    /// Creates an end of an open link, without a session.
    pub fn new() -> Self {
        Self::with(Security::Open)
    }

    /// Creates an end of a sealed link, without a session.
    pub fn sealed(support: SealSupport) -> Self {
        Self::with(Security::Sealed(support, SealSlot::new(None)))
    }

    fn with(security: Security) -> Self {
        Self {
            direction: PhantomData,
            security,
            session: SessionId::NONE,
            frame: FRAME.min(DEFAULT_FRAME),
            decoder: cobs::Decoder::default(),
            receiving: ReceiveWindow::default(),
            sending: SendWindow::default(),
            datagrams: 0,
            counters: Counters::default(),
        }
    }

    /// Begins a session with frames of `frame` bytes on the wire. Frames in flight from an earlier
    /// session are dropped: the owner must assume that they were lost.
    pub fn begin(&mut self, session: SessionId, frame: usize) {
        self.begin_with(session, frame, None);
    }

    /// Begins a session of a sealed link, like [`Endpoint::begin`]. A key must begin one session
    /// only.
    pub fn begin_sealed(
        &mut self,
        session: SessionId,
        frame: usize,
        (robot, key): (RobotId, SessionKey),
    ) {
        self.begin_with(session, frame, Some((robot, key)));
    }

    fn begin_with(
        &mut self,
        session: SessionId,
        frame: usize,
        keys: Option<(RobotId, SessionKey)>,
    ) {
        self.security.begin(keys);
        self.session = session;
        self.frame = frame.min(FRAME);
        self.receiving = ReceiveWindow::default();
        self.sending.clear();
        self.datagrams = 0;
    }

    /// Ends the session.
    pub fn end(&mut self) {
        self.begin(SessionId::NONE, FRAME.min(DEFAULT_FRAME));
    }

    /// The session, or [`SessionId::NONE`].
    pub fn session(&self) -> SessionId {
        self.session
    }

    /// The counters.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// Counts a sealed handshake frame that the owner has opened or not.
    pub fn judge(&mut self, verdict: Verdict) {
        let Counters { received, replayed, forged, refused, .. } = &mut self.counters;
        let count = match verdict {
            Verdict::Good => received,
            Verdict::Replayed => replayed,
            Verdict::Forged => forged,
            Verdict::Refused => refused,
        };
        *count = count.wrapping_add(1);
    }

    /// Whether one of the four frames written last in this sealed session has this echo
    /// ([`echo_of`](crate::frame::echo_of)).
    pub fn is_echo(&self, echo: u64) -> bool {
        self.security.is_echo(echo)
    }

    /// Whether this sealed session has used up its counters and can't send any more: the owner must
    /// open another one.
    pub fn is_spent(&self) -> bool {
        self.security.is_spent()
    }

    /// Counts a handshake frame that the owner has written.
    pub fn count_sent(&mut self) {
        self.counters.sent = self.counters.sent.wrapping_add(1);
    }

    /// Whether there is a session whose window has room for another reliable frame.
    pub fn can_send_reliable(&self) -> bool {
        self.session != SessionId::NONE && self.sending.next_sequence().is_some()
    }

    /// Bytes of messages that fit in any frame of this session, even beside an acknowledgement. A
    /// [`Writer`] needs one byte more than the message while it writes it.
    pub fn room(&self) -> usize {
        let room = self.security.capacity(self.frame);
        room.saturating_sub(if room < ROOM_FOR_TWO { 1 } else { ACK_LEN })
    }

    /// Consumes `input` up to the end of the next frame or error and returns it. Call it until it
    /// returns `None`: the input is then used up.
    pub fn receive(
        &mut self,
        input: &mut &[u8],
        now: Instant,
    ) -> Option<Received<'_, D::Opposite>> {
        let Self { decoder, security, counters, session, receiving, sending, .. } = self;
        let frame = match decoder.next(input)? {
            Ok(frame) => frame,
            Err(error) => return drop_bad(counters, FrameFault::Stuffing(error)),
        };
        let (header, payload) = match security.open::<D::Opposite>(*session, frame) {
            Ok(Opened::Session(header, payload)) => (header, payload),
            Ok(Opened::Handshake(payload)) => {
                counters.received = counters.received.wrapping_add(1);
                // Any version may say hello: the answer names the mismatch.
                return match Messages::new(payload).next() {
                    Some(Ok(message)) => Some(Received::Handshake(message)),
                    _ => refuse(counters, FrameFault::Payload),
                };
            }
            Ok(Opened::SealedHandshake(sealed)) => return Some(Received::Sealed(sealed)),
            Err(fault) => return Some(drop_frame(counters, fault)),
        };
        counters.received = counters.received.wrapping_add(1);
        if header.version != VERSION {
            return refuse(counters, FrameFault::Version(header.version));
        }
        if header.kind == FrameKind::Reliable {
            match receiving.arrive(header.sequence, now) {
                Arrival::New => {}
                Arrival::Duplicate => {
                    counters.duplicates = counters.duplicates.wrapping_add(1);
                    return Some(Received::Session(Messages::new(&[])));
                }
                Arrival::Refused => {
                    return refuse(counters, FrameFault::Sequence(header.sequence));
                }
            }
        }
        for message in Messages::<D::Opposite>::new(payload) {
            let ack = match message {
                Ok(message) if message.number != D::Opposite::ACK.into() => continue,
                Ok(message) => message.decode::<Ack>(),
                Err(malformed) => Err(malformed),
            };
            match ack {
                Ok(ack) => sending.acknowledge(ack, now),
                Err(_) => counters.refused = counters.refused.wrapping_add(1),
            }
        }
        Some(Received::Session(Messages::new(payload)))
    }

    /// The token of an acknowledged frame; each is returned once.
    #[must_use]
    pub fn poll_acknowledged(&mut self) -> Option<T> {
        self.sending.take_acknowledged()
    }

    /// Writes a handshake frame of an open link with one message, outside any session. Returns its length,
    /// or `None` if it does not fit.
    pub fn handshake<M: Body<D>>(&mut self, body: &M, out: &mut [u8]) -> Option<usize> {
        let header = Header { version: VERSION, kind: FrameKind::Handshake, sequence: 0 };
        let mut scratch = [0; FRAME];
        let (head, payload) = scratch.split_first_chunk_mut::<HEADER_LEN>()?;
        *head = header.encode();
        let mut writer = Writer::<D>::new(payload);
        if !writer.push(body) {
            return None;
        }
        let len = HEADER_LEN + writer.len();
        let contents = scratch.get(..len)?;
        let tail = seal(SessionId::NONE, D::DIRECTION, contents);
        self.count_sent();
        cobs::encode([contents, &tail], out)
    }

    /// Writes the next frame into `out` (at least as long as the agreed frame): a retransmission
    /// that is due, or a new frame that `fill` writes. `fill` gets a writer, and whether a reliable
    /// frame may be sent. If `urgent`, a new frame is sent before retransmissions. Call it until it
    /// returns `None`.
    #[must_use]
    pub fn poll_transmit(
        &mut self,
        now: Instant,
        out: &mut [u8],
        urgent: bool,
        fill: impl FnOnce(&mut Writer<'_, D>, bool) -> Fill<T>,
    ) -> Option<Transmit<T>> {
        if self.session == SessionId::NONE || self.is_spent() {
            return None;
        }
        if urgent {
            // If no new frame can be sent, retransmissions continue.
            return self.send_new(now, out, fill).or_else(|| self.send_again(now, out));
        }
        match self.send_again(now, out) {
            Some(sent) => Some(sent),
            None => self.send_new(now, out, fill),
        }
    }

    fn send_again(&mut self, now: Instant, out: &mut [u8]) -> Option<Transmit<T>> {
        let (contents, token) = self.sending.resend(now)?;
        let len = self.security.seal::<FRAME>(self.session, D::DIRECTION, contents, out)?;
        self.counters.sent = self.counters.sent.wrapping_add(1);
        self.counters.retransmissions = self.counters.retransmissions.wrapping_add(1);
        Some(Transmit { len, token: Some(token) })
    }

    fn send_new(
        &mut self,
        now: Instant,
        out: &mut [u8],
        fill: impl FnOnce(&mut Writer<'_, D>, bool) -> Fill<T>,
    ) -> Option<Transmit<T>> {
        let sequence = self.sending.next_sequence();
        let room = self.security.capacity(self.frame.min(out.len()));
        let mut scratch = [0; FRAME];
        let (head, payload) = scratch.split_first_chunk_mut::<HEADER_LEN>()?;
        let mut writer = Writer::new(payload.get_mut(..room)?);
        let due = self.receiving.due().is_some_and(|due| due <= now);
        let alone = room < ROOM_FOR_TWO;
        let owed = self.receiving.owed().filter(|_| due || !alone);
        let acknowledges = owed.is_some_and(|ack| writer.push(&ack));
        let empty = writer.len();
        let filled = match alone && acknowledges {
            true => Fill::Nothing,
            false => fill(&mut writer, sequence.is_some()),
        };
        let (kind, sequence, token) = match (filled, sequence) {
            (Fill::Reliable(token), Some(sequence)) => (FrameKind::Reliable, sequence, Some(token)),
            (Fill::Datagram, _) if writer.len() > empty => {
                (FrameKind::Datagram, self.datagrams, None)
            }
            _ if acknowledges && due => (FrameKind::Datagram, self.datagrams, None),
            _ => return None,
        };
        let len = HEADER_LEN + writer.len();
        *head = Header { version: VERSION, kind, sequence }.encode();
        let contents = scratch.get(..len)?;
        let wire = self.security.seal::<FRAME>(self.session, D::DIRECTION, contents, out)?;
        debug_assert!(contents.len() + SEAL_LEN <= FRAME);
        if let Some(token) = token {
            self.sending.keep(contents, token, now);
        } else {
            self.datagrams = (self.datagrams + 1) % SEQUENCE_MODULUS;
        }
        if acknowledges {
            self.receiving.acknowledged(now);
        }
        self.counters.sent = self.counters.sent.wrapping_add(1);
        Some(Transmit { len: wire, token })
    }

    /// When [`Endpoint::poll_transmit`] must be called even if the owner has nothing to send.
    pub fn poll_timeout(&self) -> Option<Instant> {
        if self.session == SessionId::NONE || self.is_spent() {
            return None;
        }
        Instant::earlier(self.receiving.due(), self.sending.next_deadline())
    }
}

fn drop_bad<'a, D>(counters: &mut Counters, fault: FrameFault) -> Option<Received<'a, D>> {
    counters.bad = counters.bad.wrapping_add(1);
    Some(Received::Bad(fault))
}

fn refuse<'a, D>(counters: &mut Counters, fault: FrameFault) -> Option<Received<'a, D>> {
    counters.refused = counters.refused.wrapping_add(1);
    Some(Received::Bad(fault))
}

fn drop_frame<'a, D>(counters: &mut Counters, fault: FrameFault) -> Received<'a, D> {
    let (count, stray) = match fault {
        FrameFault::Stuffing(_) | FrameFault::Seal | FrameFault::Shape => (&mut counters.bad, None),
        FrameFault::Replayed(stray) => (&mut counters.replayed, Some(stray)),
        FrameFault::Forged(stray) => (&mut counters.forged, Some(stray)),
        _ => {
            counters.received = counters.received.wrapping_add(1);
            (&mut counters.refused, None)
        }
    };
    *count = count.wrapping_add(1);
    match stray {
        Some(stray) => Received::Stray(stray, fault),
        None => Received::Bad(fault),
    }
}

#[cfg(test)]
#[cfg(feature = "seals")]
mod sealed_tests;
#[cfg(test)]
mod tests;
