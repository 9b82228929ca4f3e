//! The state of a robot's odometry calibration.

use ubimap_protocol::time::Instant;

/// The state of a robot's odometry calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum OdometryCalibration {
    /// Not calibrated; the robot may be recalled for it from this time on.
    Missing(Instant),
    /// The robot returns into view for it, or drives to and fro there.
    Due,
    /// The robot has driven far enough in view.
    Done,
}

impl OdometryCalibration {
    /// Whether the robot may be recalled for it.
    pub(super) fn is_wanted(self, now: Instant) -> bool {
        matches!(self, Self::Missing(from) if from <= now)
    }

    pub(super) fn is_due(self) -> bool {
        self == Self::Due
    }

    /// Cancels a calibration that is due; the robot explores uncalibrated until then.
    pub(super) fn put_off(&mut self, until: Instant) {
        if self.is_due() {
            *self = Self::Missing(until);
        }
    }
}
