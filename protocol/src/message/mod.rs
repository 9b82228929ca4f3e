//! Messages: one file a direction. A frame carries any number of them, each as a kind (one byte),
//! the length of its body (a varint) and the body (postcard).

mod to_robot;
mod to_server;
mod wire;

pub use to_robot::{
    EarlierFix, MAX_EARLIER_FIXES, PoseFix, Refusal, RefusalReason, TimeReply, ToRobotKind, Welcome,
};
pub use to_server::{Hello, Interest, MAX_REQUESTS, Request, State, TimeRequest, ToServerKind};
pub use wire::{Ack, MalformedMessage, Message, Messages, TileUpdateHead, Writer, decode};
