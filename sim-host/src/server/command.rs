//! What a robot is told to do.

use ubimap_protocol::message::{ParameterCommand, Path, Stop, ToRobot, Writer};

/// Parameter commands with this number and above are the server's own; users' are below.
pub(super) const FIRST_OWN_NUMBER: u16 = 0xC000;

/// Whether the number of a parameter command, or of its answer, is one of the server's own.
pub(super) fn is_own(number: u16) -> bool {
    number >= FIRST_OWN_NUMBER
}

/// A command. It is sent until the robot has acknowledged it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Stop, or drive again. It goes before everything else.
    Stop(Stop),
    /// Where to drive.
    Path(Path),
    /// Asks for parameters, or sets one. The robot answers it. Numbers from 0xC000 on are reserved
    /// for the server.
    Parameter(ParameterCommand),
}

impl Command {
    /// Whether it goes before frames that must be sent again.
    pub(super) fn is_urgent(&self) -> bool {
        matches!(self, Self::Stop(_))
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
    pub(super) fn write(&self, writer: &mut Writer<'_, ToRobot>) -> bool {
        match self {
            Self::Stop(stop) => writer.push(stop),
            Self::Path(path) => writer.push(path),
            Self::Parameter(command) => writer.push(command),
        }
    }
}
