//! The messages between the server and its robots.
//!
//! A frame carries any number of messages, each as a kind (one byte), the length of its body (a
//! varint) and the body (postcard). One file for each direction lists its kinds and their bodies;
//! [`ToServer`] and [`ToRobot`] are the directions as types, and [`Body`] gives a body type its
//! kind.
//!
//! ```
//! use ubimap_protocol::message::{Messages, Stop, ToRobot, ToRobotMessage, Writer};
//!
//! let mut payload = [0; 40];
//! let mut writer = Writer::<ToRobot>::new(&mut payload);
//! assert!(writer.push(&Stop { number: 7, stop: true }));
//! let len = writer.len();
//!
//! for message in Messages::<ToRobot>::new(&payload[..len]).flatten() {
//!     match message.by_kind() {
//!         Some(ToRobotMessage::Stop(stop)) => assert_eq!(stop.decode().unwrap().number, 7),
//!         Some(other) => println!("not of interest: {other:?}"),
//!         None => println!("a kind of a later version: {}", message.number),
//!     }
//! }
//! ```
//!
//! Sending a message in the wrong direction does not compile:
//!
//! ```compile_fail,E0277
//! use ubimap_protocol::message::{Stop, ToServer, Writer};
//!
//! let mut payload = [0; 40];
//! let mut writer = Writer::<ToServer>::new(&mut payload);
//! let _ = writer.push(&Stop { number: 7, stop: true });
//! ```

mod added;
mod direction;
mod reader;
mod shared;
mod table;
mod to_robot;
mod to_server;
mod wire;

pub use direction::{Body, Direction, ToRobot, ToServer, Traffic};
pub use shared::{
    Ack, Digests, MAX_DIGESTS, MAX_PARAMETERS, MAX_REQUESTS, ParameterValue, Request,
    SEQUENCE_MODULUS, TileDigest, TileUpdateHead,
};
pub use to_robot::{
    Certainty, EarlierFix, FixSource, Freshness, MAX_EARLIER_FIXES, MAX_FRESH_BYTES, MAX_OBSTACLES,
    MAX_PEERS, MAX_STORED, MAX_WAYPOINTS, Obstacle, ObstacleClass, Obstacles, ParameterAction,
    ParameterCommand, Path, Peer, Peers, PoseFix, Posture, Postures, Refusal, RefusalReason, Reset,
    SealedReset, Stop, Stored, TimeReply, ToRobotKind, ToRobotMessage, Waypoint, Welcome,
};
pub use to_server::{
    DistanceVector, Event, EventCode, Hello, Interest, MAX_COLUMNS, MAX_DETAIL, ParameterOutcome,
    ParameterReport, Severity, State, TimeRequest, ToServerKind, ToServerMessage,
};
pub use wire::{Encoded, MalformedMessage, Message, Messages, Writer};
