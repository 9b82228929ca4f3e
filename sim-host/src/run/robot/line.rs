//! A port of the robot's computer, which is opened again whenever it comes back.

use ubimap_agent::Port;
use ubimap_protocol::time::{Duration, Instant};

use crate::channel::{
    intake::{Intake, Listening, SourceId},
    wire::{Wire, WireError, WireWriter},
};

/// Interval between attempts to open a port that has hung up.
const REOPEN_INTERVAL: Duration = Duration::from_secs(1);

/// A port of the robot's computer.
pub(super) struct Line {
    pub(super) port: Port,
    name: String,
    opener: Box<dyn FnMut() -> Result<Wire, WireError>>,
    open: Option<(Box<dyn WireWriter>, Listening)>,
    next_attempt: Instant,
    has_failed: bool,
}

impl Line {
    /// A port with this name, which `opener` opens.
    pub(super) fn new(
        port: Port,
        name: String,
        opener: impl FnMut() -> Result<Wire, WireError> + 'static,
    ) -> Self {
        let opener = Box::new(opener);
        Self { port, name, opener, open: None, next_attempt: Instant(0), has_failed: false }
    }

    /// Opens the port if that is due.
    pub(super) fn look_after(&mut self, intake: &mut Intake<()>, now: Instant) {
        if self.open.is_some() || now < self.next_attempt {
            return;
        }
        self.next_attempt = now + REOPEN_INTERVAL;
        let opened =
            (self.opener)().and_then(|Wire { reader, writer }| Ok((writer, intake.wire(reader)?)));
        match opened {
            Ok(open) => {
                let what = match self.port {
                    Port::Server => "says hello to the server",
                    _ => "open",
                };
                log::info!("{}: {what}", self.name);
                (self.open, self.has_failed) = (Some(open), false);
            }
            Err(error) => {
                if !self.has_failed {
                    log::warn!("{error}; trying again every second");
                }
                self.has_failed = true;
            }
        }
    }

    /// Writes bytes; lost while the port is closed.
    pub(super) fn write(&mut self, bytes: &[u8]) {
        let Some((writer, _)) = &mut self.open else { return };
        match writer.write(bytes) {
            // A stalled line loses bytes, as one without flow control does.
            Ok(()) | Err(WireError::Stalled { .. }) => {}
            Err(error) => self.failed(&error),
        }
    }

    /// Whether arrivals of this source are the port's.
    pub(super) fn is_source(&self, source: SourceId) -> bool {
        self.open.as_ref().is_some_and(|(_, listening)| listening.source() == source)
    }

    /// Closes the port after a failure; it is opened again.
    pub(super) fn failed(&mut self, error: &WireError) {
        log::warn!("{error}; trying again every second");
        (self.open, self.has_failed) = (None, true);
    }
}
