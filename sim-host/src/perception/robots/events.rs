//! What is seen of robots and cannot be a pose.

use core::fmt;

use ubimap_protocol::units::RobotId;

use crate::perception::markers::Identifier;

/// Something about a marker, or about a frame, that somebody should look at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum SightingEvent {
    /// A tag that nobody registered.
    Unregistered(Identifier),
    /// Its identifier is at two places at once: two robots carry it, or two cameras disagree.
    SeenTwice(RobotId),
    /// It was where no wheels could have brought it since it was last seen.
    Jumped(RobotId),
    /// Its marker is not level, or not at the height or of the size that is registered.
    NotLevel(RobotId),
    /// A camera's frames are of times that are still to come.
    ClockAhead {
        /// Which camera.
        camera: usize,
    },
}

impl fmt::Display for SightingEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unregistered(Identifier::Tag(number)) => {
                write!(f, "tag {number} is not registered")
            }
            Self::Unregistered(Identifier::Colours { head, tail }) => {
                write!(f, "a marker of {head:?} and {tail:?} is not registered")
            }
            Self::SeenTwice(robot) => write!(f, "robot {} is at two places at once", robot.0),
            Self::Jumped(robot) => write!(f, "robot {} has jumped", robot.0),
            Self::ClockAhead { camera } => write!(f, "the clock of camera {camera} is ahead"),
            Self::NotLevel(robot) => {
                write!(f, "the marker of robot {} is not level, or not as registered", robot.0)
            }
        }
    }
}
