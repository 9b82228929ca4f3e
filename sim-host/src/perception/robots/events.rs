//! Problems with markers and frames.

use core::fmt;

use ubimap_protocol::units::RobotId;

use crate::perception::markers::Identifier;

/// A problem with a marker or a frame that needs attention.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum SightingEvent {
    /// A marker that is not registered.
    Unregistered(Identifier),
    /// An identifier is seen in two places at once: two robots carry it, or two cameras disagree.
    SeenTwice(RobotId),
    /// A robot moved faster than it can drive since it was last seen.
    Jumped(RobotId),
    /// A marker is not level, or its registered height or size is wrong.
    NotLevel(RobotId),
    /// A camera's frames have capture times in the future.
    ClockAhead {
        /// The camera's index.
        camera: usize,
    },
}

impl fmt::Display for SightingEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unregistered(Identifier::Tag(number)) => {
                write!(
                    f,
                    "tag {number} belongs to no registered robot: add it to the robots file, or take it away"
                )
            }
            Self::Unregistered(Identifier::Colours { head, tail }) => {
                write!(
                    f,
                    "a marker of {head} and {tail} belongs to no registered robot: add it to the robots file, or \
                     take it away"
                )
            }
            Self::SeenTwice(robot) => write!(
                f,
                "robot {} is seen in two places at once; check that its marker is unique",
                robot.0
            ),
            Self::Jumped(robot) => write!(
                f,
                "robot {} moved faster than it can drive; check that its marker is unique",
                robot.0
            ),
            Self::ClockAhead { camera } => {
                write!(f, "camera {camera}: frames from the future; check its clock")
            }
            Self::NotLevel(robot) => {
                write!(
                    f,
                    "the marker of robot {} is not level, or its registered height or size is wrong",
                    robot.0
                )
            }
        }
    }
}
