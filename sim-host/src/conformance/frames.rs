//! Frames written and read as they are, without an endpoint: a tester must be able to send wrong ones,
//! and to see what others send.

use ubimap_protocol::{
    frame::{
        Direction, FrameKind, HEADER_LEN, Header, MAX_FRAME, SEAL_LEN, SessionId, VERSION,
        cobs::{self, CobsError},
        open, seal,
    },
    message::{Body, Messages, TileUpdateHead, ToRobot, ToServer, Traffic, Writer},
    tile::{Layer, Stamp, Tile, TileEncoder, TileId, Version},
};

/// A message: the number of its kind, and its body.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Note {
    /// The number of the kind.
    pub number: u8,
    /// The encoded body.
    pub body: Vec<u8>,
}

impl Note {
    /// A message with this body.
    pub fn new<D: Traffic, B: Body<D>>(body: &B) -> Self {
        let mut buffer = [0; MAX_FRAME];
        let mut writer = Writer::<D>::new(&mut buffer);
        // No body of the protocol is longer than the largest frame.
        let _ = writer.push(body);
        let len = writer.len();
        let message = Messages::<D>::new(&buffer[..len]).flatten().next();
        message.map_or(Self { number: 0, body: Vec::new() }, |message| Self {
            number: message.number,
            body: message.body.to_vec(),
        })
    }

    /// Appends the message to a payload.
    pub fn write(&self, payload: &mut Vec<u8>) {
        payload.push(self.number);
        let mut len = self.body.len();
        while len >= 0x80 {
            payload.push(len as u8 | 0x80);
            len >>= 7;
        }
        payload.push(len as u8);
        payload.extend_from_slice(&self.body);
    }
}

/// A message with a tile: its id, stamp and base, and its cells before and after.
pub fn tile_note<D: Traffic>(
    layer: Layer,
    tile: (TileId, Stamp, Option<Version>),
    was: &Tile,
    is: &Tile,
) -> Note
where
    TileUpdateHead: Body<D>,
{
    part_note::<D>(layer, tile, 0, (was, is), MAX_FRAME).0
}

/// A message with a part of a tile that takes at most `room` bytes, from a cell on; and the cell after
/// the part's last.
pub fn part_note<D: Traffic>(
    layer: Layer,
    (id, stamp, base): (TileId, Stamp, Option<Version>),
    start: u16,
    (was, is): (&Tile, &Tile),
    room: usize,
) -> (Note, u16)
where
    TileUpdateHead: Body<D>,
{
    let mut note = Note::new::<D, _>(&TileUpdateHead { layer, seconds: 1 });
    let mut coded = [0; MAX_FRAME];
    let mut encoder = TileEncoder::new(coded.get_mut(..room).unwrap_or_default());
    let end = encoder.push(id, stamp, base, start, was, is);
    let len = encoder.finish().unwrap_or(0);
    note.body.extend_from_slice(&coded[..len]);
    (note, end.unwrap_or(start))
}

/// The payload with these messages.
pub fn payload(notes: &[Note]) -> Vec<u8> {
    let mut payload = Vec::new();
    notes.iter().for_each(|note| note.write(&mut payload));
    payload
}

/// A frame before it is stuffed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// The session whose seal it has, or [`SessionId::NONE`].
    pub session: SessionId,
    /// Where it goes.
    pub direction: Direction,
    /// Its header.
    pub header: Header,
    /// Its messages.
    pub payload: Vec<u8>,
}

impl Frame {
    /// A frame of this version.
    pub fn new(
        session: SessionId,
        direction: Direction,
        (kind, sequence): (FrameKind, u16),
        notes: &[Note],
    ) -> Self {
        let header = Header { version: VERSION, kind, sequence };
        Self { session, direction, header, payload: payload(notes) }
    }

    /// Header, payload and seal.
    pub fn contents(&self) -> Vec<u8> {
        let mut contents = self.header.encode().to_vec();
        contents.extend_from_slice(&self.payload);
        let tail = seal(self.session, self.direction, &contents);
        contents.extend_from_slice(&tail);
        contents
    }

    /// The bytes on the wire.
    pub fn wire(&self) -> Vec<u8> {
        stuffed(&self.contents())
    }

    /// Reads the contents of a frame in a direction, with the first of the sessions whose seal is good,
    /// or none.
    ///
    /// # Errors
    /// [`Unreadable`].
    pub fn read(
        contents: &[u8],
        direction: Direction,
        sessions: impl IntoIterator<Item = SessionId>,
    ) -> Result<Self, Unreadable> {
        let mut sessions = sessions.into_iter().chain([SessionId::NONE]);
        let found = sessions
            .find_map(|session| Some((session, open(session, direction, contents)?)))
            .ok_or(Unreadable::Seal)?;
        let (session, opened) = found;
        let (header, payload) = Header::decode(opened).ok_or(Unreadable::Header)?;
        Ok(Self { session, direction, header, payload: payload.to_vec() })
    }

    /// Its messages up to the first that is cut short, and whether one is.
    pub fn notes(&self) -> (Vec<Note>, bool) {
        match self.direction {
            Direction::ToServer => notes::<ToServer>(&self.payload),
            Direction::ToRobot => notes::<ToRobot>(&self.payload),
        }
    }
}

fn notes<D: Traffic>(payload: &[u8]) -> (Vec<Note>, bool) {
    let mut read = Vec::new();
    for message in Messages::<D>::new(payload) {
        let Ok(message) = message else { return (read, true) };
        read.push(Note { number: message.number, body: message.body.to_vec() });
    }
    (read, false)
}

/// Why a frame can't be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unreadable {
    /// It is not stuffed correctly.
    Stuffing(CobsError),
    /// No known session, and not session 0, has this seal in this direction.
    Seal,
    /// The header is incomplete or of the reserved kind.
    Header,
}

/// The contents, stuffed and delimited.
pub fn stuffed(contents: &[u8]) -> Vec<u8> {
    let mut wire = vec![0; cobs::encoded_len(contents.len())];
    let len = cobs::encode([contents, &[]], &mut wire).unwrap_or(0);
    wire.truncate(len);
    wire
}

/// The contents of stuffed bytes that end with a delimiter.
///
/// # Errors
/// [`CobsError`].
pub fn unstuffed(wire: &[u8]) -> Result<Vec<u8>, CobsError> {
    let mut decoder = cobs::Decoder::<{ 2 * MAX_FRAME }>::default();
    match decoder.next(&mut &wire[..]) {
        Some(contents) => contents.map(|contents| contents.to_vec()),
        None => Err(CobsError::Truncated),
    }
}

/// The shortest contents of a frame.
pub(super) const MIN_CONTENTS: usize = HEADER_LEN + SEAL_LEN;
