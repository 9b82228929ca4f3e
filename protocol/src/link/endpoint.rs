//! One end of a link: turns bytes into messages and messages into frames.

use core::marker::PhantomData;

use super::{
    acknowledgement::{Arrival, ReceiveWindow, SendWindow},
    fault::FrameFault,
};
use crate::{
    frame::{
        DEFAULT_FRAME, FrameKind, HEADER_LEN, Header, MIN_VERSION, SEAL_LEN, SEQUENCE_MODULUS,
        VERSION, cobs, open, payload_capacity, seal,
    },
    message::{Ack, Body, Message, Messages, Traffic, Writer},
    time::Instant,
    units::SessionId,
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
    /// Frames with wrong stuffing, excessive length or a bad seal.
    pub bad: u32,
    /// Well-sealed frames that violate the protocol: a malformed message, a sequence number outside
    /// the window, an unsupported version.
    pub refused: u32,
}

/// What an endpoint received, in direction `D`.
#[derive(Debug)]
pub enum Received<'a, D> {
    /// A message outside any session.
    Handshake(Message<'a, D>),
    /// The messages of a frame of this session; duplicates are left out. Acknowledgements are
    /// included, although the endpoint has already processed them.
    Session(Messages<'a, D>),
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
    /// Creates an end without a session.
    pub fn new() -> Self {
        Self {
            direction: PhantomData,
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

    /// Whether there is a session whose window has room for another reliable frame.
    pub fn can_send_reliable(&self) -> bool {
        self.session != SessionId::NONE && self.sending.next_sequence().is_some()
    }

    /// Bytes of messages that fit in any frame of this session, even beside an acknowledgement.
    pub fn room(&self) -> usize {
        let room = payload_capacity(self.frame);
        if room < ROOM_FOR_TWO { room } else { room.saturating_sub(ACK_LEN) }
    }

    /// Consumes `input` up to the end of the next frame or error and returns it. Call it until it
    /// returns `None`: the input is then used up.
    pub fn receive(
        &mut self,
        input: &mut &[u8],
        now: Instant,
    ) -> Option<Received<'_, D::Opposite>> {
        let incoming = D::Opposite::DIRECTION;
        let Self { decoder, counters, session, receiving, sending, .. } = self;
        let frame = match decoder.next(input)? {
            Ok(frame) => frame,
            Err(error) => return drop_bad(counters, FrameFault::Stuffing(error)),
        };
        let opened = (*session != SessionId::NONE)
            .then(|| open(*session, incoming, frame))
            .flatten()
            .map(|contents| (contents, false))
            .or_else(|| Some((open(SessionId::NONE, incoming, frame)?, true)));
        let Some((contents, outside)) = opened else {
            return drop_bad(counters, FrameFault::Seal);
        };
        counters.received = counters.received.wrapping_add(1);
        let Some((header, payload)) = Header::decode(contents) else {
            return refuse(counters, FrameFault::Header);
        };
        if outside != (header.kind == FrameKind::Handshake) {
            return refuse(counters, FrameFault::Kind);
        }
        if outside {
            // Any version may say hello: the answer names the mismatch.
            return match Messages::new(payload).next() {
                Some(Ok(message)) => Some(Received::Handshake(message)),
                _ => refuse(counters, FrameFault::Payload),
            };
        }
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

    /// Writes a handshake frame with one message, sealed outside any session. Returns its length,
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
        self.counters.sent = self.counters.sent.wrapping_add(1);
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
        if self.session == SessionId::NONE {
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
        let tail = seal(self.session, D::DIRECTION, contents);
        let len = cobs::encode([contents, &tail], out)?;
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
        let room = payload_capacity(self.frame.min(out.len()));
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
        let tail = seal(self.session, D::DIRECTION, contents);
        let wire = cobs::encode([contents, &tail], out)?;
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
        if self.session == SessionId::NONE {
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

#[cfg(test)]
mod tests;
