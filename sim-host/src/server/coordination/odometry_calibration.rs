//! What is known of the calibration of a robot's odometry.

use ubimap_protocol::time::Instant;

/// What is known of the calibration of a robot's odometry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum OdometryCalibration {
    /// It is missing. The robot may be called into view for it from then on.
    Missing(Instant),
    /// The robot comes into view for it, or drives there.
    Due,
    /// The robot has driven far enough in view.
    Done,
}

impl OdometryCalibration {
    /// Whether the robot may be called into view for it.
    pub(super) fn is_wanted(self, now: Instant) -> bool {
        match self {
            Self::Missing(from) => from <= now,
            Self::Due => true,
            Self::Done => false,
        }
    }

    pub(super) fn is_due(self) -> bool {
        self == Self::Due
    }

    /// Lets the robot explore without it until then.
    pub(super) fn put_off(&mut self, until: Instant) {
        if self.is_due() {
            *self = Self::Missing(until);
        }
    }
}
