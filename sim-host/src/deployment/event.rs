//! Events of a deployment.

use core::fmt;

use super::camera_event::CameraEvent;
use crate::{camera::Observation, perception::FrameError, server};

/// Something that happened in a deployment.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A frame or observation was processed; contains the result.
    Observed(Observation),
    /// A camera has started to deliver faulty frames.
    Frame(FrameError),
    /// A camera has moved.
    Camera(CameraEvent),
    /// An event about robots or people.
    Server(server::Event),
}

impl Event {
    /// The log level of the event.
    pub fn level(&self) -> log::Level {
        match self {
            Self::Observed(_) => log::Level::Trace,
            Self::Frame(_) => log::Level::Warn,
            Self::Camera(event) => event.level(),
            Self::Server(event) => event.level(),
        }
    }
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Observed(Observation { camera, robots, cells, .. }) => {
                write!(
                    f,
                    "camera {camera}: {} robots localised, {} cells observed",
                    robots.len(),
                    cells.len()
                )
            }
            Self::Frame(error) => error.fmt(f),
            Self::Camera(event) => event.fmt(f),
            Self::Server(event) => event.fmt(f),
        }
    }
}
