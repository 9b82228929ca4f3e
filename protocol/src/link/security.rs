//! What protects an endpoint's frames: checksums on an open link, authenticated encryption on a
//! sealed one.

use super::{fault::FrameFault, replay_window::ReplayWindow, sealed_handshake::SealedHandshake};
use crate::{
    frame::{
        FrameKind, Header, MAX_FRAME, SESSION_CLEAR_LEN, SealSlot, SealSupport, SessionKey, Stray,
        TAG_LEN, cobs, echo_of, is_sealed, open, open_session, payload_capacity, seal,
        seal_session, sealed_payload_capacity,
    },
    message::{Direction, Traffic},
    units::{RobotId, SessionId},
};

/// Number of sent frames that a Reset may answer.
const ECHOES: usize = 4;

/// The policy of a link.
#[derive(Debug)]
pub(super) enum Security {
    /// Frames have a checksum.
    Open,
    /// Frames are sealed; all others are refused.
    Sealed(SealSupport, SealSlot<SealedSession>),
}

/// The two directions of a sealed session.
#[derive(Debug)]
pub(super) struct SealedSession {
    key: SessionKey,
    robot: RobotId,
    /// Number of frames written, retransmissions included: the next one's counter.
    written: u32,
    window: ReplayWindow,
    /// The echoes of the frames written last.
    echoes: [u64; ECHOES],
}

/// An undamaged frame.
pub(super) enum Opened<'f> {
    /// A frame of the session.
    Session(Header, &'f [u8]),
    /// The payload of an open handshake frame.
    Handshake(&'f [u8]),
    /// A handshake frame that the owner of the endpoint must open.
    SealedHandshake(SealedHandshake<'f>),
}

impl Security {
    /// Number of bytes for messages in a frame of `frame` bytes on the wire.
    pub(super) fn capacity(&self, frame: usize) -> usize {
        match self {
            Self::Open => payload_capacity(frame),
            Self::Sealed(..) => sealed_payload_capacity(frame),
        }
    }

    /// Begins a session, with keys if it is sealed.
    pub(super) fn begin(&mut self, keys: Option<(RobotId, SessionKey)>) {
        if let Self::Sealed(_, session) = self {
            *session = SealSlot::new(keys.map(|(robot, key)| SealedSession::new(robot, key)));
        }
    }

    /// Whether no frame can be written in this session any more.
    pub(super) fn is_spent(&self) -> bool {
        self.sealed().is_some_and(|session| session.written == u32::MAX)
    }

    /// Whether one of the frames written last had this echo.
    pub(super) fn is_echo(&self, echo: u64) -> bool {
        self.sealed().is_some_and(|session| {
            let newest = session.written.min(ECHOES as u32) as usize;
            session.echoes.iter().take(newest).any(|&sent| sent == echo)
        })
    }

    fn sealed(&self) -> Option<&SealedSession> {
        match self {
            Self::Open => None,
            Self::Sealed(_, session) => session.get(),
        }
    }

    /// Seals `contents` (header and messages) and writes them to `out`, stuffed. Returns the
    /// length, or `None` if they do not fit.
    pub(super) fn seal<const FRAME: usize>(
        &mut self,
        session: SessionId,
        direction: Direction,
        contents: &[u8],
        out: &mut [u8],
    ) -> Option<usize> {
        match self {
            Self::Open => cobs::encode([contents, &seal(session, direction, contents)], out),
            Self::Sealed(_, sealed) => {
                sealed.get_mut()?.seal::<FRAME>(session, direction, contents, out)
            }
        }
    }

    /// Opens a frame in place.
    pub(super) fn open<'f, D: Traffic>(
        &mut self,
        session: SessionId,
        frame: &'f mut [u8],
    ) -> Result<Opened<'f>, FrameFault> {
        match self {
            Self::Open => open_plain::<D>(session, frame),
            Self::Sealed(_, sealed) => open_sealed::<D>(sealed.get_mut(), session, frame),
        }
    }
}

/// Whether a frame in direction `D` can be opened as one of the first of a sealed session.
pub fn is_of_session<D: Traffic>(
    frame: &[u8],
    session: SessionId,
    (robot, key): (RobotId, SessionKey),
) -> bool {
    let mut copy = [0; MAX_FRAME];
    let Some(copy) = copy.get_mut(..frame.len()) else { return false };
    copy.copy_from_slice(frame);
    let mut ours = SealedSession::new(robot, key);
    matches!(open_sealed::<D>(Some(&mut ours), session, copy), Ok(Opened::Session(..)))
}

fn open_plain<D: Traffic>(session: SessionId, frame: &[u8]) -> Result<Opened<'_>, FrameFault> {
    let opened = (session != SessionId::NONE)
        .then(|| open(session, D::DIRECTION, frame))
        .flatten()
        .map(|contents| (contents, false))
        .or_else(|| Some((open(SessionId::NONE, D::DIRECTION, frame)?, true)));
    let (contents, outside) = opened.ok_or(FrameFault::Seal)?;
    let (header, payload) = Header::decode(contents).ok_or(FrameFault::Header)?;
    if outside != (header.kind == FrameKind::Handshake) {
        return Err(FrameFault::Kind);
    }
    if is_sealed(contents) && !outside {
        // What was a version of three bits.
        return Err(FrameFault::Version(header.version | 4));
    }
    Ok(if outside { Opened::Handshake(payload) } else { Opened::Session(header, payload) })
}

fn open_sealed<'f, D: Traffic>(
    sealed: Option<&mut SealedSession>,
    session: SessionId,
    frame: &'f mut [u8],
) -> Result<Opened<'f>, FrameFault> {
    if !is_sealed(frame) {
        // Noise, or a robot without a key: that is worth telling apart.
        let is_open = open(SessionId::NONE, D::DIRECTION, frame).is_some();
        return Err(if is_open { FrameFault::Unsealed } else { FrameFault::Seal });
    }
    let (header, _) = Header::decode(frame).ok_or(FrameFault::Shape)?;
    if header.kind == FrameKind::Handshake {
        let handshake = SealedHandshake::parse(frame).ok_or(FrameFault::Shape)?;
        return Ok(Opened::SealedHandshake(handshake));
    }
    let (clear, rest) =
        frame.split_first_chunk_mut::<SESSION_CLEAR_LEN>().ok_or(FrameFault::Shape)?;
    let (text, tag) = rest.split_last_chunk_mut::<TAG_LEN>().ok_or(FrameFault::Shape)?;
    let [_, _, robot @ .., low, high] = *clear;
    let stray = Stray { robot: RobotId(u16::from_le_bytes(robot)), echo: echo_of(tag) };
    let ours = sealed.filter(|ours| ours.robot == stray.robot);
    let ours = ours.ok_or(FrameFault::Forged(stray))?;
    let counter = ours.window.whole(u16::from_le_bytes([low, high]));
    if !ours.window.is_new(counter) {
        return Err(FrameFault::Replayed(stray));
    }
    let names = (ours.robot, session);
    if !open_session(&ours.key, names, D::DIRECTION, clear, counter, (text, tag)) {
        return Err(FrameFault::Forged(stray));
    }
    ours.window.accept(counter);
    Ok(Opened::Session(header, text))
}

impl SealedSession {
    fn new(robot: RobotId, key: SessionKey) -> Self {
        let window = ReplayWindow::default();
        Self { key, robot, written: 0, window, echoes: [0; ECHOES] }
    }

    /// Sets the next counter.
    #[cfg(test)]
    pub(super) fn set_written(&mut self, written: u32) {
        self.written = written;
    }

    /// See [`Security::seal`]. Every call uses up a counter, so that no nonce is used twice even if
    /// the frame turns out not to fit.
    fn seal<const FRAME: usize>(
        &mut self,
        session: SessionId,
        direction: Direction,
        contents: &[u8],
        out: &mut [u8],
    ) -> Option<usize> {
        let counter = self.written;
        self.written = counter.checked_add(1)?;
        let (header, messages) = Header::decode(contents)?;
        let mut scratch = [0; FRAME];
        let space = scratch.get_mut(..messages.len() + TAG_LEN)?;
        let (text, tag) = space.split_last_chunk_mut::<TAG_LEN>()?;
        text.copy_from_slice(messages);
        let names = (self.robot, session);
        let (clear, sealed) = seal_session(&self.key, names, direction, header, counter, text);
        *tag = sealed;
        if let Some(oldest) = self.echoes.get_mut(counter as usize % ECHOES) {
            *oldest = echo_of(tag);
        }
        cobs::encode([&clear, space], out)
    }
}
