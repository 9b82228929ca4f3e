//! What a robot needs of its wheels.

use ubimap_protocol::{time::Instant, units::Pose};

use crate::drive::{DriveCommand, StopReason};

/// What a base reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WheelReport {
    /// When the wheels were read.
    pub moment: Instant,
    /// `base_link` in `odom`.
    pub pose: Pose,
    /// Why the robot must stop now; `None` if it may drive.
    pub stop: Option<StopReason>,
}

/// Counters of a base's driver.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WheelCounters {
    /// Reports received.
    pub frames: u32,
    /// Reports with a wrong checksum.
    pub damaged: u32,
    /// Times that the base was started again after silence.
    pub restarts: u32,
}

/// A driver of wheels behind a port: a parser of its bytes, without input or output.
pub trait Wheels {
    /// Processes bytes that had arrived by `now`, from the front of `bytes`, up to the end of the
    /// next report. `None`: all bytes are used up.
    fn receive(&mut self, bytes: &mut &[u8], now: Instant) -> Option<WheelReport>;

    /// Sets the command for the wheels. Call it at least every 50 ms.
    fn drive(&mut self, command: DriveCommand, now: Instant);

    /// Writes the next bytes to the base into `out`, which should hold 16 bytes. Returns their
    /// number.
    fn poll_transmit(&mut self, now: Instant, out: &mut [u8]) -> Option<usize>;

    /// The latest time for the next call of [`Wheels::poll_transmit`].
    fn poll_timeout(&self) -> Instant;

    /// Whether the base has not reported for too long to drive.
    fn is_silent(&self, now: Instant) -> bool;

    /// The driver's counters.
    fn counters(&self) -> WheelCounters;
}
