//! Reading and writing the messages in a frame's payload.

use core::{cell::Cell, fmt, marker::PhantomData, ops::RangeInclusive};

use serde::de::DeserializeOwned;

use super::{
    direction::{Body, Traffic},
    reader::Reader,
};

/// A message body that cannot be decoded as its kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MalformedMessage;

impl fmt::Display for MalformedMessage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the message cannot be decoded as its kind")
    }
}

impl core::error::Error for MalformedMessage {}

/// A message body that is still encoded.
pub struct Encoded<'a, T> {
    body: &'a [u8],
    decoded: PhantomData<T>,
}

impl<'a, T: DeserializeOwned> Encoded<'a, T> {
    pub(super) fn new(body: &'a [u8]) -> Self {
        Self { body, decoded: PhantomData }
    }

    /// Decodes the body. Trailing bytes (fields added since) are ignored, and added fields that are
    /// absent have their defaults.
    ///
    /// # Errors
    /// [`MalformedMessage`] if the body cannot be decoded.
    pub fn decode(self) -> Result<T, MalformedMessage> {
        decode(&mut Reader::new(self.body))
    }

    /// Decodes the fixed part of the body and returns it with the remaining bytes, such as the
    /// coded tiles of an update.
    ///
    /// # Errors
    /// [`MalformedMessage`] if the fixed part cannot be decoded.
    pub fn split(self) -> Result<(T, &'a [u8]), MalformedMessage> {
        let mut reader = Reader::new(self.body);
        let head = decode(&mut reader)?;
        Ok((head, reader.rest()))
    }
}

// Written by hand: `derive` would require `T: Clone`.
impl<T> Clone for Encoded<'_, T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Encoded<'_, T> {}

impl<T> fmt::Debug for Encoded<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Encoded").field(&self.body).finish()
    }
}

fn decode<T: DeserializeOwned>(reader: &mut Reader<'_>) -> Result<T, MalformedMessage> {
    T::deserialize(reader).map_err(|_| MalformedMessage)
}

/// A message of direction `D` and any kind, whose body is still encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Message<'a, D> {
    /// The number of its kind, which may be unknown.
    pub number: u8,
    /// The encoded body of the message.
    pub body: &'a [u8],
    direction: PhantomData<D>,
}

impl<'a, D: Traffic> Message<'a, D> {
    /// A message with the kind's number and an encoded body.
    pub fn new(number: u8, body: &'a [u8]) -> Self {
        Self { number, body, direction: PhantomData }
    }

    /// The kind of the message, or `None` if this version does not know it.
    pub fn kind(self) -> Option<D::Kind> {
        D::kind(self.number)
    }

    /// The message as the enum of its direction's kinds, which gives the body its type. `None` if
    /// this version does not know the kind.
    pub fn by_kind(self) -> Option<D::Message<'a>> {
        D::message(self.number, self.body)
    }

    /// Decodes the body as `T`.
    ///
    /// # Errors
    /// [`MalformedMessage`] if the message is of another kind or cannot be decoded.
    pub fn decode<T: Body<D>>(self) -> Result<T, MalformedMessage> {
        self.encoded()?.decode()
    }

    /// Decodes a body that begins with `T`: see [`Encoded::split`].
    ///
    /// # Errors
    /// [`MalformedMessage`] if the message is of another kind or `T` cannot be decoded.
    pub fn split<T: Body<D>>(self) -> Result<(T, &'a [u8]), MalformedMessage> {
        self.encoded()?.split()
    }

    fn encoded<T: Body<D>>(self) -> Result<Encoded<'a, T>, MalformedMessage> {
        if self.number != T::KIND.into() {
            return Err(MalformedMessage);
        }
        Ok(Encoded::new(self.body))
    }
}

/// Iterates over the messages of a frame's payload, in direction `D`. Ends after the first error.
#[derive(Clone, Debug)]
pub struct Messages<'a, D> {
    rest: &'a [u8],
    direction: PhantomData<D>,
}

impl<'a, D: Traffic> Messages<'a, D> {
    /// The messages in `payload`.
    pub fn new(payload: &'a [u8]) -> Self {
        Self { rest: payload, direction: PhantomData }
    }

    fn split(&mut self) -> Option<Message<'a, D>> {
        let (&number, rest) = self.rest.split_first()?;
        let (len, rest) = Encoded::<u16>::new(rest).split().ok()?;
        let (body, rest) = rest.split_at_checked(usize::from(len))?;
        self.rest = rest;
        Some(Message::new(number, body))
    }
}

impl<'a, D: Traffic> Iterator for Messages<'a, D> {
    type Item = Result<Message<'a, D>, MalformedMessage>;

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

/// Writes messages of direction `D` into the payload of a frame.
#[derive(Debug)]
pub struct Writer<'a, D> {
    buffer: &'a mut [u8],
    len: usize,
    direction: PhantomData<D>,
}

/// Maximum length of a message's kind and length, in bytes.
const HEAD_LEN: usize = 3;

impl<'a, D: Traffic> Writer<'a, D> {
    /// Writes to `buffer` from its start.
    pub fn new(buffer: &'a mut [u8]) -> Self {
        Self { buffer, len: 0, direction: PhantomData }
    }

    /// Number of bytes written.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether nothing has been written.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Maximum size of the next message's body, in bytes.
    pub fn room(&self) -> usize {
        self.buffer.len().saturating_sub(self.len + HEAD_LEN)
    }

    /// Adds a message. Returns false, and writes nothing, if it does not fit.
    #[must_use]
    pub fn push<T: Body<D>>(&mut self, body: &T) -> bool {
        self.write(T::KIND.into(), |space| Some(postcard::to_slice(body, space).ok()?.len()))
            .is_some()
    }

    /// Adds a message whose body begins with `head`. `rest` writes the remainder and returns its
    /// length, or `None` to cancel. Returns false, and writes nothing, if cancelled or if the
    /// message does not fit.
    #[must_use]
    pub fn push_with<T: Body<D>>(
        &mut self,
        head: &T,
        rest: impl FnOnce(&mut [u8]) -> Option<usize>,
    ) -> bool {
        let written = self.write(T::KIND.into(), |space| {
            let head_len = postcard::to_slice(head, space).ok()?.len();
            Some(head_len + rest(space.get_mut(head_len..)?)?)
        });
        written.is_some()
    }

    /// Adds the longest message that fits: `body` builds it with a given number of elements, and
    /// the numbers in `counts` are tried from the highest down. Returns the number that fitted, or
    /// `None`, with nothing written, if none did.
    #[must_use]
    pub fn push_longest<T: Body<D>>(
        &mut self,
        counts: RangeInclusive<usize>,
        mut body: impl FnMut(usize) -> T,
    ) -> Option<usize> {
        let (min, mut count) = counts.into_inner();
        while count >= min {
            if self.push(&body(count)) {
                return Some(count);
            }
            count = count.checked_sub(1)?;
        }
        None
    }

    /// Adds an encoded message of any kind. Returns false, and writes nothing, if it does not fit.
    #[must_use]
    pub fn push_encoded(&mut self, message: Message<'_, D>) -> bool {
        let Message { number, body, .. } = message;
        let written = self.write(number, |space| {
            space.get_mut(..body.len())?.copy_from_slice(body);
            Some(body.len())
        });
        written.is_some()
    }

    fn write(&mut self, number: u8, body: impl FnOnce(&mut [u8]) -> Option<usize>) -> Option<()> {
        // The body is written after the longest possible head, then moved down to the actual one.
        let space = self.buffer.get_mut(self.len..)?.get_mut(HEAD_LEN..)?;
        let body_len = body(space)?;
        self.close(number, body_len)
    }

    /// Writes the head before a body that is already in place. Not inlined, so that the firmware
    /// has it once instead of once for each kind of message.
    #[inline(never)]
    fn close(&mut self, number: u8, body_len: usize) -> Option<()> {
        let space = self.buffer.get_mut(self.len..)?;
        let (head, body) = space.split_at_mut_checked(HEAD_LEN)?;
        *head.first_mut()? = number;
        let len_len =
            postcard::to_slice(&u16::try_from(body_len).ok()?, head.get_mut(1..)?).ok()?.len();
        if body_len > body.len() {
            return None;
        }
        let start = 1 + len_len;
        // `copy_within` would bring its panics into the firmware.
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
    use crate::{
        message::{
            Ack, Request, TileUpdateHead, ToRobot, ToRobotKind, ToServer, ToServerKind,
            ToServerMessage,
        },
        tile::{Layer, TileId},
    };
    use proptest::prelude::*;

    #[test]
    fn messages_read_back_in_order() {
        let mut buffer = [0u8; 300];
        let mut writer = Writer::<ToServer>::new(&mut buffer);
        let ack = Ack { next: 7, later: 5 };
        let head = TileUpdateHead { layer: Layer::Robot, seconds: 9 };
        assert!(writer.is_empty());
        assert!(writer.push(&ack));
        assert!(!writer.is_empty());
        assert!(writer.push_with(&head, |rest| {
            rest[..200].fill(3);
            Some(200)
        }));
        assert!(!writer.push_with(&head, |_| None));
        assert!(!writer.push_with(&head, |rest| (rest.len() >= 200).then_some(200)));
        assert!(writer.push_encoded(Message::new(99, &[1, 2])));
        let len = writer.len();
        let mut messages = Messages::<ToServer>::new(&buffer[..len]);
        let first = messages.next().unwrap().unwrap();
        assert_eq!((first.number, first.decode()), (0, Ok(ack)));
        assert_eq!(first.kind(), Some(ToServerKind::Ack));
        assert_eq!(first.decode::<TileUpdateHead>(), Err(MalformedMessage), "of another kind");
        let second = messages.next().unwrap().unwrap().by_kind().unwrap();
        let ToServerMessage::TileUpdate(update) = second else { panic!("{second:?}") };
        assert_eq!(update.split(), Ok((head, &[3u8; 200][..])));
        let third = messages.next().unwrap().unwrap();
        assert_eq!((third.number, third.body, third.kind()), (99, &[1u8, 2][..], None));
        assert!(third.by_kind().is_none());
        assert_eq!(messages.next(), None);
    }

    #[test]
    fn a_body_as_long_as_the_room_fits_and_a_longer_one_does_not() {
        for size in 0..300 {
            let mut buffer = [0u8; 300];
            let mut writer = Writer::<ToServer>::new(&mut buffer[..size]);
            let is_second = writer.push_encoded(Message::new(98, &[1, 2]));
            assert_eq!(is_second, size >= HEAD_LEN + 2);
            let room = writer.room();
            let taken = if is_second { writer.len() } else { 0 } + HEAD_LEN;
            assert_eq!(room, size.saturating_sub(taken), "{size}");
            assert!(!writer.push_encoded(Message::new(99, &[7; 301][..room + 1])), "{size}");
            let fits = writer.push_encoded(Message::new(99, &[7; 301][..room]));
            assert_eq!(fits, size >= taken, "{size}");
        }
    }

    #[test]
    fn the_longest_message_that_fits_is_written() {
        let request = |count| Request {
            layer: Layer::Robot,
            tiles: core::iter::repeat_n(TileId { x: 1, y: 1 }, count).collect(),
        };
        // Sizes: up to three bytes for kind and length, layer, count, two for each tile.
        for (room, expected) in [(4, None), (5, None), (7, Some(1)), (10, Some(2)), (99, Some(4))] {
            let mut buffer = [0u8; 99];
            let mut writer = Writer::<ToRobot>::new(&mut buffer[..room]);
            assert_eq!(writer.push_longest(1..=4, request), expected, "{room}");
            let len = writer.len();
            let written = Messages::<ToRobot>::new(&buffer[..len]).next();
            let written = written.map(|message| message.unwrap().decode());
            assert_eq!(written, expected.map(|count| Ok(request(count))), "{room}");
        }
    }

    #[test]
    fn kinds_and_numbers_correspond_one_to_one() {
        fn check<D: Traffic>(all: &[D::Kind]) {
            let known: std::vec::Vec<u8> =
                (0..=u8::MAX).filter(|&it| D::kind(it).is_some()).collect();
            let numbers: std::vec::Vec<u8> = all.iter().map(|&kind| kind.into()).collect();
            assert_eq!(known, numbers);
            assert!(all.iter().all(|&kind| D::kind(kind.into()) == Some(kind)));
            assert!(known.iter().all(|&number| D::message(number, &[]).is_some()));
        }
        check::<ToServer>(ToServerKind::ALL);
        check::<ToRobot>(ToRobotKind::ALL);
    }

    proptest! {
        #[test]
        fn reading_any_bytes_ends(payload in proptest::collection::vec(any::<u8>(), 0..300)) {
            let count = Messages::<ToServer>::new(&payload).count();
            prop_assert!(count <= payload.len());
        }
    }
}
