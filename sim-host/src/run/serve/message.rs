//! What the other threads of a server tell its core.

use std::sync::mpsc;

use nalgebra::Isometry3;
use ubimap_protocol::time::Instant;

use crate::{
    camera::Observation,
    perception::{FrameError, robots::SightingEvent, steadiness::Change},
    run::control::Request,
};

/// A message to the core.
#[derive(Debug)]
pub(super) enum Message {
    /// Nothing: perception checks whether the core is still there.
    Idle,
    /// Perception has looked at a frame.
    Perceived(Box<Perceived>),
    /// A request from a command, and where the answer goes.
    Request(Request, mpsc::Sender<Result<String, String>>),
}

/// What perception has made of a frame. Times are since the server's start.
#[derive(Debug)]
pub(super) struct Perceived {
    pub(super) observation: Observation,
    pub(super) events: Vec<(Instant, SightingEvent)>,
    /// Changes of the camera's pose: the capture time, the change, and its pose before.
    pub(super) moves: Vec<(Instant, Change, Option<Isometry3<f64>>)>,
    pub(super) fault: Option<FrameError>,
    /// When the frame arrived.
    pub(super) arrived: Instant,
}
