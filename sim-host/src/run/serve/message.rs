//! What the other threads of a server tell its core.

use std::sync::mpsc;

use nalgebra::Isometry3;
use ubimap_protocol::{
    time::Instant,
    units::{Pose, RobotId},
};

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
    /// Perception asks where robots were at a time, and where the answer goes.
    Whereabouts(Instant, mpsc::Sender<Vec<(RobotId, Pose)>>),
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
    pub(super) moves: Vec<Move>,
    pub(super) fault: Option<FrameError>,
    /// When the frame arrived.
    pub(super) arrived: Instant,
}

/// A change of a camera's pose, which may be another camera than that of the frame that shows it.
#[derive(Debug)]
pub(super) struct Move {
    pub(super) camera: usize,
    /// When the frame was captured that shows it.
    pub(super) captured: Instant,
    pub(super) change: Change,
    /// Its last known pose.
    pub(super) before: Option<Isometry3<f64>>,
}
