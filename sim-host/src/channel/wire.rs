//! The two ends of a link to a robot, and their errors.

use std::{fmt, io, time::Duration};

/// Errors of a link. Each message is one line that names the port.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// The port could not be opened.
    #[error("{name}: {reason}")]
    Open {
        /// The port.
        name: String,
        /// The reason, with advice if the cause is known.
        reason: String,
    },
    /// The other end is gone: the adapter was unplugged, the pseudo-terminal or connection closed.
    #[error("{name}: disconnected; check the cable and the robot")]
    HungUp {
        /// The port.
        name: String,
    },
    /// The process at the other end has closed its output.
    #[error("{name}: {how}")]
    Ended {
        /// The command.
        name: String,
        /// How it ended.
        how: String,
    },
    /// The peer accepts no data and the queue is full; these bytes were not queued.
    #[error("{name}: the peer accepts no data")]
    Stalled {
        /// The port.
        name: String,
    },
    /// Any other error.
    #[error("{name}: {reason}")]
    Io {
        /// The port.
        name: String,
        /// The operating system's error.
        reason: io::Error,
    },
}

impl WireError {
    /// The error for a socket that can't be bound.
    pub(crate) fn unbound(name: String, error: &io::Error) -> Self {
        const IN_USE: &str = "in use by another program, such as an ubimap serve that runs already; stop that one, or \
                              give another port";
        let is_in_use = error.kind() == io::ErrorKind::AddrInUse;
        let reason = if is_in_use { IN_USE.to_owned() } else { error.to_string() };
        Self::Open { name, reason }
    }
}

/// The end of a link at which bytes arrive.
pub trait WireReader: Send {
    /// Reads bytes that have arrived, and waits up to `wait` for the first one. Returns their
    /// number, possibly 0.
    ///
    /// # Errors
    /// Any [`WireError`] except `Stalled`; the link can then no longer be used.
    fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, WireError>;
}

/// The end of a link that sends bytes.
pub trait WireWriter: Send {
    /// Queues bytes, all or none, without blocking.
    ///
    /// # Errors
    /// [`WireError::Stalled`] if there is no room now; after any other error the link can no longer
    /// be used.
    fn write(&mut self, bytes: &[u8]) -> Result<(), WireError>;
}

/// Both ends of a link.
pub struct Wire {
    /// Receives from the robot.
    pub reader: Box<dyn WireReader>,
    /// Sends to the robot.
    pub writer: Box<dyn WireWriter>,
}

impl fmt::Debug for Wire {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Wire")
    }
}
