//! The two directions of a link as values and as types, and what ties a message body to its kind.

use core::fmt::Debug;

use serde::{Serialize, de::DeserializeOwned};

/// Which way a frame or a message travels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Direction {
    /// From a robot to the server.
    ToServer = 0,
    /// From the server to a robot.
    ToRobot = 1,
}

/// Messages from a robot to the server. A type without values: see [`Traffic`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ToServer {}

/// Messages from the server to a robot. A type without values: see [`Traffic`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ToRobot {}

/// The messages of one direction: [`ToServer`] or [`ToRobot`].
///
/// Writers, readers and endpoints take a direction as a type parameter, so that a message that does
/// not travel that way does not compile.
pub trait Traffic: Copy + Debug + Eq + 'static {
    /// The kinds of messages.
    type Kind: Copy + Debug + Eq + Into<u8>;
    /// A received message: one variant for each kind, with its encoded body.
    type Message<'a>: Copy + Debug;
    /// The messages that travel the other way.
    type Opposite: Traffic<Opposite = Self>;
    /// The same direction as a value.
    const DIRECTION: Direction;
    /// The kind of acknowledgements.
    const ACK: Self::Kind;

    /// The kind of a number, or `None` if this version does not know it.
    fn kind(number: u8) -> Option<Self::Kind>;

    /// The message of a kind's number and a body, or `None` if this version does not know the kind.
    fn message(number: u8, body: &[u8]) -> Option<Self::Message<'_>>;
}

/// The body of a message that travels in direction `D`. Implemented by the tables of kinds in
/// `to_server.rs` and `to_robot.rs` alone.
#[diagnostic::on_unimplemented(message = "`{Self}` is not the body of a message `{D}`")]
pub trait Body<D: Traffic>: Serialize + DeserializeOwned {
    /// Its kind.
    const KIND: D::Kind;
}
