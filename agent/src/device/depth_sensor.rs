//! What a robot needs of a depth sensor.

use ubimap_protocol::time::Instant;

/// A scan that a sensor's driver has completed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Scan<'s> {
    /// When it was taken: the exposure, not the arrival.
    pub taken: Instant,
    /// One reading per column in millimetres, 0 for no return.
    pub readings: &'s [u16],
}

/// Counters of a depth sensor's driver.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SensorCounters {
    /// Frames that became scans.
    pub frames: u32,
    /// Frames that were cut or damaged, and were dropped.
    pub torn: u32,
    /// Times that the sensor was configured again after silence.
    pub restarts: u32,
}

/// A driver of a depth sensor behind a port: a parser of its bytes, without input or output.
pub trait DepthSensor {
    /// Processes bytes that had arrived by `now`, from the front of `bytes`, up to the end of the
    /// next complete frame. `None`: all bytes are used up.
    fn receive(&mut self, bytes: &mut &[u8], now: Instant) -> Option<Scan<'_>>;

    /// Writes the next bytes to the sensor into `out`, which should hold 32 bytes. Returns their
    /// number.
    fn poll_transmit(&mut self, now: Instant, out: &mut [u8]) -> Option<usize>;

    /// The latest time for the next call of [`DepthSensor::poll_transmit`].
    fn poll_timeout(&self) -> Instant;

    /// The driver's counters.
    fn counters(&self) -> SensorCounters;
}
