//! What a deployment tells whoever runs it.

use core::fmt;

use crate::{camera::Observation, perception::FrameError, server};

/// Something that has happened.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A frame has been looked at, or an observation taken: what it says.
    Observed(Observation),
    /// The frames of a camera have begun to be wrong in some way.
    Frame(FrameError),
    /// Something about robots or people.
    Server(server::Event),
}

impl Event {
    /// How much it matters.
    pub fn level(&self) -> log::Level {
        match self {
            Self::Observed(_) => log::Level::Trace,
            Self::Frame(_) => log::Level::Warn,
            Self::Server(event) => event.level(),
        }
    }
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Observed(Observation { camera, robots, cells, .. }) => {
                write!(f, "camera {camera}: {} robots, {} cells", robots.len(), cells.len())
            }
            Self::Frame(error) => error.fmt(f),
            Self::Server(event) => event.fmt(f),
        }
    }
}
