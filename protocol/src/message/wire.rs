//! How messages stand in a frame, and those that both directions share.

use core::cell::Cell;

use heapless::Vec;
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::reader::Reader;
use crate::tile::{Layer, Stamp, TileId};

/// Acknowledges reliable frames. The same in both directions, kind 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ack {
    /// All reliable frames before this sequence number have arrived.
    pub next: u16,
    /// Bit `i` set: the frame `next + 1 + i` has arrived as well.
    pub later: u32,
}

impl Ack {
    /// The kind of this message, in both directions.
    pub const KIND: u8 = 0;
}

/// The most parameters of a robot.
pub const MAX_PARAMETERS: usize = 16;

/// A parameter and its value; SPEC.md lists the parameters, their units and ranges.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParameterValue {
    /// Which parameter.
    pub parameter: u16,
    /// Its value, in its unit.
    pub value: i32,
}

/// The most tiles in one [`Digests`].
pub const MAX_DIGESTS: usize = 8;

/// What the writer of a layer has, of a few of its tiles: whoever holds an older state, or other
/// cells, asks for the tile. The same in both directions.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Digests {
    /// The layer.
    pub layer: Layer,
    /// The tiles.
    pub tiles: Vec<TileDigest, MAX_DIGESTS>,
}

/// The state of one tile.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TileDigest {
    /// Which tile.
    pub id: TileId,
    /// Its state.
    pub stamp: Stamp,
    /// The hash of its cells ([`tile_hash`](crate::tile::tile_hash)).
    pub hash: u32,
}

/// What precedes the coded tiles in the body of a tile update.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TileUpdateHead {
    /// The layer that the tiles belong to.
    pub layer: Layer,
    /// When the newest scan in them was taken: whole seconds of the server's clock; for the
    /// server's layers, the map time.
    pub seconds: u32,
}

impl TileUpdateHead {
    /// Writes the head at the start of a message body. `None` if it does not fit.
    pub fn encode(self, body: &mut [u8]) -> Option<&[u8]> {
        Some(postcard::to_slice(&self, body).ok()?)
    }
}

/// A body that is not what its kind says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MalformedMessage;

/// Reads the fixed part of a message body; what follows it is given back as well.
pub fn decode<T: DeserializeOwned>(body: &[u8]) -> Result<(T, &[u8]), MalformedMessage> {
    let mut reader = Reader::new(body);
    let message = T::deserialize(&mut reader).map_err(|_| MalformedMessage)?;
    Ok((message, reader.rest().map_err(|_| MalformedMessage)?))
}

/// One message of a frame, undecoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Message<'a> {
    /// The kind; what it means depends on the direction.
    pub kind: u8,
    /// The body.
    pub body: &'a [u8],
}

/// The messages of a frame's payload.
#[derive(Clone, Debug)]
pub struct Messages<'a> {
    rest: &'a [u8],
}

impl<'a> Messages<'a> {
    /// The messages of this payload.
    pub fn new(payload: &'a [u8]) -> Self {
        Self { rest: payload }
    }

    fn split(&mut self) -> Option<Message<'a>> {
        let (&kind, rest) = self.rest.split_first()?;
        let (len, rest) = decode::<u16>(rest).ok()?;
        let (body, rest) = rest.split_at_checked(usize::from(len))?;
        self.rest = rest;
        Some(Message { kind, body })
    }
}

impl<'a> Iterator for Messages<'a> {
    type Item = Result<Message<'a>, MalformedMessage>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.rest.is_empty() {
            return None;
        }
        let message = self.split();
        if message.is_none() {
            self.rest = &[];
        }
        Some(message.ok_or(MalformedMessage))
    }
}

/// Writes messages, one after another, into the payload of a frame.
#[derive(Debug)]
pub struct Writer<'a> {
    buffer: &'a mut [u8],
    len: usize,
}

/// The most bytes that kind and length take.
const HEAD_LEN: usize = 3;

impl<'a> Writer<'a> {
    /// Writes into this buffer from its start.
    pub fn new(buffer: &'a mut [u8]) -> Self {
        Self { buffer, len: 0 }
    }

    /// Bytes written so far.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether nothing has been written.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Bytes left for the body of one more message.
    pub fn room(&self) -> usize {
        self.buffer.len().saturating_sub(self.len + HEAD_LEN)
    }

    /// Adds a message. `false`, and nothing written, if it does not fit.
    #[must_use]
    pub fn push<T: Serialize>(&mut self, kind: u8, body: &T) -> bool {
        self.push_with(kind, |buffer| Some(postcard::to_slice(body, buffer).ok()?.len()))
    }

    /// Adds a message whose body `fill` writes; it returns the length, or `None` to write none
    /// after all. `false`, and nothing written, then or if it does not fit.
    #[must_use]
    pub fn push_with(&mut self, kind: u8, fill: impl FnOnce(&mut [u8]) -> Option<usize>) -> bool {
        self.try_push(kind, fill).is_some()
    }

    fn try_push(&mut self, kind: u8, fill: impl FnOnce(&mut [u8]) -> Option<usize>) -> Option<()> {
        // The body is written where the longest head would end, then moved down to the real one.
        let space = self.buffer.get_mut(self.len..)?.get_mut(HEAD_LEN..)?;
        let body_len = fill(space)?;
        self.close(kind, body_len)
    }

    /// Puts the head before a body that has been written. Apart, so that it is in the firmware
    /// once and not for each kind of message.
    #[inline(never)]
    fn close(&mut self, kind: u8, body_len: usize) -> Option<()> {
        let space = self.buffer.get_mut(self.len..)?;
        let (head, body) = space.split_at_mut_checked(HEAD_LEN)?;
        *head.first_mut()? = kind;
        let len_len =
            postcard::to_slice(&u16::try_from(body_len).ok()?, head.get_mut(1..)?).ok()?.len();
        if body_len > body.len() {
            return None;
        }
        let start = 1 + len_len;
        // Not by `copy_within`, which brings its panics into the firmware.
        let cells = Cell::from_mut(space).as_slice_of_cells();
        let moves = cells.iter().skip(start).zip(cells.iter().skip(HEAD_LEN)).take(body_len);
        moves.for_each(|(to, from)| to.set(from.get()));
        self.len += start + body_len;
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn messages_read_back_in_order() {
        let mut buffer = [0u8; 300];
        let mut writer = Writer::new(&mut buffer);
        let ack = Ack { next: 7, later: 5 };
        assert!(writer.push(Ack::KIND, &ack));
        assert!(writer.push_with(9, |body| {
            body[..200].fill(3);
            Some(200)
        }));
        assert!(!writer.push_with(9, |_| None));
        assert!(!writer.push_with(9, |body| (body.len() >= 200).then_some(200)));
        let len = writer.len();
        let mut messages = Messages::new(&buffer[..len]);
        let first = messages.next().unwrap().unwrap();
        assert_eq!((first.kind, decode::<Ack>(first.body)), (0, Ok((ack, &[][..]))));
        let second = messages.next().unwrap().unwrap();
        assert_eq!((second.kind, second.body), (9, &[3u8; 200][..]));
        assert_eq!(messages.next(), None);
    }

    proptest! {
        #[test]
        fn any_bytes_end(payload in proptest::collection::vec(any::<u8>(), 0..300)) {
            let count = Messages::new(&payload).count();
            prop_assert!(count <= payload.len());
        }
    }
}
