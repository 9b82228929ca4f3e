//! Commands to robots.

use ubimap_protocol::message::{ParameterCommand, Path, Stop, ToRobot, Writer};

/// First number of the server's own parameter commands; users' commands have lower numbers.
pub(super) const FIRST_OWN_NUMBER: u16 = 0xC000;

/// Whether a parameter command's or report's number is one of the server's own.
pub(super) fn is_own(number: u16) -> bool {
    number >= FIRST_OWN_NUMBER
}

/// A command. It is sent until the robot acknowledges it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Stop, or resume driving. Sent before everything else.
    Stop(Stop),
    /// The path to drive.
    Path(Path),
    /// Reads parameters or sets one; the robot answers. Numbers from 0xC000 on are reserved for the
    /// server.
    Parameter(ParameterCommand),
}

impl Command {
    /// Whether the command is sent before retransmissions.
    pub(super) fn is_urgent(&self) -> bool {
        matches!(self, Self::Stop(_))
    }

    /// Whether the command stays in force until another command of its kind.
    pub(super) fn stands(&self) -> bool {
        matches!(self, Self::Stop(_) | Self::Path(_))
    }

    /// Whether a newer command makes this one obsolete before it is sent.
    pub(super) fn is_replaced_by(&self, newer: &Self) -> bool {
        !matches!(self, Self::Parameter(_))
            && core::mem::discriminant(self) == core::mem::discriminant(newer)
    }

    /// Adds the message to a frame. Returns false if it does not fit.
    pub(super) fn write(&self, writer: &mut Writer<'_, ToRobot>) -> bool {
        match self {
            Self::Stop(stop) => writer.push(stop),
            Self::Path(path) => writer.push(path),
            Self::Parameter(command) => writer.push(command),
        }
    }
}
