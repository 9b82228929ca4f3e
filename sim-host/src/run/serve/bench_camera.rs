//! The bench's stand-in for cameras.

use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use crate::camera::{Observation, Sighting};

/// Frame interval of the simulated camera of the bench: 15 Hz.
pub const CAPTURE_INTERVAL: Duration = Duration::from_micros(66_667);

/// The simulated camera of the bench: it sees each robot with a session at its configured pose.
#[derive(Debug, Default)]
pub(super) struct BenchCamera {
    next: Instant,
}

impl BenchCamera {
    /// Time of the next frame.
    pub(super) fn next(&self) -> Instant {
        self.next
    }

    /// The frame that is due. Frames late by more than one interval are skipped.
    pub(super) fn poll(
        &mut self,
        now: Instant,
        robots: impl Iterator<Item = (RobotId, Pose)>,
    ) -> Option<Observation> {
        if now < self.next {
            return None;
        }
        let interval = CAPTURE_INTERVAL.micros();
        let captured = Instant(now.micros() / interval * interval);
        self.next = captured + CAPTURE_INTERVAL;
        let robots = robots.map(|(robot, pose)| Sighting::usual(robot, pose)).collect();
        Some(Observation { captured, robots, ..Observation::default() })
    }
}
