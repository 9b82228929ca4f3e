//! Distance vectors to the server, now and then: from them it measures the error of the robot's
//! pose.

use ubimap_protocol::{
    message::{DistanceVector, ToServerKind, Writer},
    time::{Duration, Instant},
};

/// A robot that stands still tells nothing new: one in a minute at most.
const STANDING_INTERVAL: Duration = Duration::from_secs(60);

/// When to send the next one, and the one that is to be sent.
#[derive(Debug)]
pub(crate) struct DistanceVectors {
    interval: Duration,
    /// When the scan of the last one was taken (robot's clock).
    last: Option<Instant>,
    waiting: Option<DistanceVector>,
}

impl DistanceVectors {
    /// At most one in `interval`.
    pub(crate) fn new(interval: Duration) -> Self {
        Self { interval, last: None, waiting: None }
    }

    /// A session has begun: the server has none.
    pub(crate) fn begin_session(&mut self) {
        (self.last, self.waiting) = (None, None);
    }

    /// Whether one is due from a scan of this moment (robot's clock).
    pub(crate) fn is_due(&self, taken: Instant, moves: bool) -> bool {
        let wait = if moves { self.interval } else { self.interval.max(STANDING_INTERVAL) };
        self.last.is_none_or(|last| taken >= last + wait)
    }

    /// Takes the one that is due; one that has not been sent gives way to it.
    pub(crate) fn take(&mut self, taken: Instant, vector: DistanceVector) {
        self.last = Some(taken);
        self.waiting = Some(vector);
    }

    /// Adds the one that waits to a frame that has room for it.
    pub(crate) fn push(&mut self, writer: &mut Writer<'_>) {
        let sent = |vector: &mut _| writer.push(ToServerKind::DistanceVector as u8, vector);
        self.waiting.take_if(sent);
    }
}
