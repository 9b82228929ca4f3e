//! The directions of a link, as values and as types, and the trait that gives a message body its
//! kind.

use core::fmt::Debug;

use serde::{Serialize, de::DeserializeOwned};

/// The direction of a frame or a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Direction {
    /// From a robot to the server.
    ToServer = 0,
    /// From the server to a robot.
    ToRobot = 1,
}

/// Messages from a robot to the server. A type parameter without values: see [`Traffic`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ToServer {}

/// Messages from the server to a robot. A type parameter without values: see [`Traffic`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ToRobot {}

/// The messages of one direction: [`ToServer`] or [`ToRobot`].
///
/// Writers, readers and endpoints take a direction as a type parameter, so that sending a message
/// in the wrong direction does not compile.
pub trait Traffic: Copy + Debug + Eq + 'static {
    /// The kinds of messages.
    type Kind: Copy + Debug + Eq + Into<u8>;
    /// A received message: one variant for each kind, holding its encoded body.
    type Message<'a>: Copy + Debug;
    /// The opposite direction.
    type Opposite: Traffic<Opposite = Self>;
    /// The same direction as a value.
    const DIRECTION: Direction;
    /// The kind of acknowledgements.
    const ACK: Self::Kind;

    /// The kind with this number, or `None` if this version does not know it.
    fn kind(number: u8) -> Option<Self::Kind>;

    /// A message from its kind's number and its body, or `None` if this version does not know the
    /// kind.
    fn message(number: u8, body: &[u8]) -> Option<Self::Message<'_>>;
}

/// The body of a message that travels in direction `D`. Implemented only by the tables of kinds in
/// `to_server.rs` and `to_robot.rs`.
#[diagnostic::on_unimplemented(message = "`{Self}` is not the body of a message `{D}`")]
pub trait Body<D: Traffic>: Serialize + DeserializeOwned {
    /// The kind of message that has this body.
    const KIND: D::Kind;
}
