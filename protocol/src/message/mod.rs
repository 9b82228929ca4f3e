//! Messages: one file a direction. A frame carries any number of them, each as a kind (one byte),
//! the length of its body (a varint) and the body (postcard).

mod reader;
mod to_robot;
mod to_server;
mod wire;

pub use to_robot::{
    Certainty, EarlierFix, FixSource, Freshness, MAX_EARLIER_FIXES, MAX_FRESH_BYTES, MAX_OBSTACLES,
    MAX_PEERS, MAX_STORED, MAX_WAYPOINTS, Obstacle, ObstacleClass, Obstacles, ParameterAction,
    ParameterCommand, Path, Peer, Peers, PoseFix, Refusal, RefusalReason, Stop, Stored, TimeReply,
    ToRobotKind, Waypoint, Welcome,
};
pub use to_server::{
    DistanceVector, Event, EventCode, Hello, Interest, MAX_COLUMNS, MAX_DETAIL, MAX_REQUESTS,
    ParameterOutcome, ParameterReport, Request, Severity, State, TimeRequest, ToServerKind,
};
pub use wire::{
    Ack, Digests, MAX_DIGESTS, MAX_PARAMETERS, MalformedMessage, Message, Messages, ParameterValue,
    TileDigest, TileUpdateHead, Writer, decode,
};
