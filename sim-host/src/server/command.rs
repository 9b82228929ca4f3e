//! What the server says to a robot of its own accord.

use ubimap_protocol::message::{
    Obstacles, ParameterCommand, Path, Peers, Stop, ToRobotKind, Writer,
};

/// A command, or news of the robot's surroundings.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Stop, or drive again. Goes before everything else, and arrives for certain.
    Stop(Stop),
    /// Where to drive. Arrives for certain.
    Path(Path),
    /// Asks for parameters, or sets one. Arrives for certain, and is answered.
    Parameter(ParameterCommand),
    /// The other robots near it. Sent once: the next one makes it obsolete.
    Peers(Peers),
    /// What else stands or moves about. Sent once: the next one makes it obsolete.
    Obstacles(Obstacles),
}

impl Command {
    /// Whether it goes before frames that must be sent again.
    pub(super) fn is_urgent(&self) -> bool {
        matches!(self, Self::Stop(_))
    }

    /// Whether it is sent until it has arrived.
    pub(super) fn is_reliable(&self) -> bool {
        matches!(self, Self::Stop(_) | Self::Path(_) | Self::Parameter(_))
    }

    /// Whether it holds until another one of its kind comes.
    pub(super) fn stands(&self) -> bool {
        matches!(self, Self::Stop(_) | Self::Path(_))
    }

    /// Whether a newer command makes this one, unsent as yet, obsolete.
    pub(super) fn is_replaced_by(&self, newer: &Self) -> bool {
        !matches!(self, Self::Parameter(_))
            && core::mem::discriminant(self) == core::mem::discriminant(newer)
    }

    /// Adds the message to a frame. `false` if it does not fit.
    pub(super) fn write(&self, writer: &mut Writer<'_>) -> bool {
        match self {
            Self::Stop(stop) => writer.push(ToRobotKind::Stop as u8, stop),
            Self::Path(path) => writer.push(ToRobotKind::Path as u8, path),
            Self::Parameter(command) => writer.push(ToRobotKind::Parameter as u8, command),
            Self::Peers(peers) => writer.push(ToRobotKind::Peers as u8, peers),
            Self::Obstacles(obstacles) => writer.push(ToRobotKind::Obstacles as u8, obstacles),
        }
    }
}
