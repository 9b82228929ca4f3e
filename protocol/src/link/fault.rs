//! Why a received frame is dropped.

use core::fmt;

use crate::frame::{MIN_VERSION, Stray, VERSION, cobs::CobsError};

/// Why an endpoint dropped a frame, in the order of the checks (SPEC 2.6, 12.3). The first two and
/// [`Shape`](Self::Shape) are counted as bad, the last two by their names, the others as refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameFault {
    /// The bytes between two delimiters are not a frame.
    Stuffing(CobsError),
    /// The seal is valid neither for the current session nor outside any session.
    Seal,
    /// The header is incomplete, or its kind is the reserved one.
    Header,
    /// A handshake frame sealed in the session, or another frame sealed outside of it.
    Kind,
    /// A handshake frame without a complete message.
    Payload,
    /// The version is not supported.
    Version(u8),
    /// The sequence number of a reliable frame is outside the window.
    Sequence(u16),
    /// On a sealed link, a handshake frame of an open one.
    Unsealed,
    /// A sealed frame of the reserved kind, or that is too short, or too long for a handshake.
    Shape,
    /// A sealed frame of a session that was accepted before, or is too old to tell.
    Replayed(Stray),
    /// A sealed frame of a session that the session here does not open.
    Forged(Stray),
}

impl fmt::Display for FrameFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stuffing(error) => error.fmt(f),
            Self::Seal => {
                f.write_str("its seal is wrong: it is damaged, or of another session or direction")
            }
            Self::Header => f.write_str("it has no complete header of a known kind"),
            Self::Kind => f.write_str(
                "a handshake frame must be sealed outside any session, and only a handshake frame",
            ),
            Self::Payload => f.write_str("it is a handshake frame without a complete message"),
            Self::Version(version) => {
                write!(f, "it has version {version}, and {MIN_VERSION} to {VERSION} are spoken")
            }
            Self::Sequence(sequence) => {
                write!(f, "its sequence number {sequence} is outside the window")
            }
            Self::Unsealed => f.write_str("it is not sealed, and this link requires it"),
            Self::Shape => f.write_str("it has the wrong length or kind for a sealed frame"),
            Self::Replayed(stray) => {
                let robot = stray.robot.0;
                write!(f, "it names robot {robot}, and its counter was used before: a replay")
            }
            Self::Forged(stray) => {
                let robot = stray.robot.0;
                write!(
                    f,
                    "it names robot {robot}, and no session here opens it: a wrong key, another session, or damaged"
                )
            }
        }
    }
}
