//! Events that occur at a fixed rate.

use ubimap_protocol::time::{Duration, Instant};

use super::scenario::CameraConfig;

/// Time step of the simulation; frames and scans are taken at its multiples.
pub const STEP: Duration = Duration::from_millis(10);

/// An event that recurs at a rate, aligned to the steps of the simulation.
pub(super) struct Cadence {
    rate: f64,
    count: u64,
}

impl Cadence {
    pub(super) fn new(rate: f64) -> Self {
        Self { rate, count: 0 }
    }

    /// The first step at or after the exact time, so that the rate is kept on average.
    pub(super) fn due(&self) -> Instant {
        let steps = self.count as f64 / self.rate * 1e6 / STEP.micros() as f64;
        // Tolerates rounding of the division: 10 Hz is exactly ten steps.
        Instant::from_micros((steps - 1e-6).ceil().max(0.0) as u64 * STEP.micros())
    }

    /// Whether the event occurs now; if so, advances to the next one.
    pub(super) fn is_due(&mut self, now: Instant) -> bool {
        let is_due = self.due() <= now;
        self.count += u64::from(is_due);
        is_due
    }
}

/// The capture times of a camera's frames, and their minimum latency.
pub(super) struct FrameSchedule {
    frames: Cadence,
    latency: Duration,
    fails: Option<Instant>,
}

impl FrameSchedule {
    pub(super) fn new(config: &CameraConfig) -> Self {
        let micros = |micros: f64| micros.round() as u64;
        Self {
            frames: Cadence::new(config.rate_hz),
            latency: Duration::from_micros(micros(config.latency_ms * 1000.0)),
            fails: config.fails_at_s.map(|at| Instant::from_micros(micros(at * 1e6))),
        }
    }

    /// Whether a frame is captured now; if so, advances to the next one.
    pub(super) fn is_due(&mut self, now: Instant) -> bool {
        self.frames.is_due(now)
    }

    /// Whether the camera has failed, so that no more frames arrive.
    pub(super) fn has_failed(&self, now: Instant) -> bool {
        self.fails.is_some_and(|moment| moment <= now)
    }

    pub(super) fn latency(&self) -> Duration {
        self.latency
    }

    /// The earliest arrival of the next frame to be captured; `None` if there will be none.
    pub(super) fn next_arrival(&self) -> Option<Instant> {
        let due = self.frames.due();
        (!self.has_failed(due)).then_some(due + self.latency)
    }
}
