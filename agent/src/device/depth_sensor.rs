//! What a robot needs of a depth sensor.

use ubimap_protocol::time::Instant;

/// A scan that a sensor's driver has completed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Scan<'s> {
    /// When it was taken: the exposure, not the arrival.
    pub taken: Instant,
    /// One reading per column in millimetres; 0 for no return, or
    /// [`NOTHING_IN_RANGE`](crate::sense::NOTHING_IN_RANGE) if the sensor tells that nothing is there.
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
///
/// A sensor of one's own: three ultrasonic sensors on a small board, which sends `FF` and the distances
/// to the left, ahead and to the right in centimetres.
///
/// ```
/// use ubimap_agent::{
///     Bounds, Config, Machine, Memory, Port,
///     device::{DepthSensor, Scan, SensorCounters, create2::Create2},
///     drive::NoDrive,
///     memory,
///     sense::SensorModel,
/// };
/// use ubimap_protocol::{time::Instant, units::RobotId};
///
/// #[derive(Default)]
/// struct Sonars {
///     /// Number of distances of the current frame.
///     received: usize,
///     readings: [u16; 3],
///     counters: SensorCounters,
/// }
///
/// impl DepthSensor for Sonars {
///     fn receive(&mut self, bytes: &mut &[u8], now: Instant) -> Option<Scan<'_>> {
///         loop {
///             let (&byte, rest) = bytes.split_first()?;
///             *bytes = rest;
///             if byte == 0xFF {
///                 self.counters.torn += u32::from(self.received % 3 != 0);
///                 self.received = 0;
///             } else if let Some(reading) = self.readings.get_mut(self.received) {
///                 *reading = u16::from(byte) * 10;
///                 self.received += 1;
///                 if self.received == 3 {
///                     self.counters.frames += 1;
///                     return Some(Scan { taken: now, readings: &self.readings });
///                 }
///             }
///         }
///     }
///
///     fn counters(&self) -> SensorCounters {
///         self.counters
///     }
/// }
///
/// // The first beam looks 45 degrees to the left, the others follow clockwise.
/// const SONARS: SensorModel = SensorModel::Radial { first: 0.785, step: -0.785 };
/// const BOUNDS: Bounds = Bounds { readings: 3, ..Bounds::SMALL };
///
/// let config = Config::new(RobotId(1), SONARS, BOUNDS);
/// let mut memory: Box<memory!(BOUNDS)> = Box::new(Memory::EMPTY);
/// let mut machine: Machine<'_, _, _, NoDrive> =
///     Machine::new(config, &mut memory, Sonars::default(), Create2::new())?;
/// // Half a frame, a whole one in two pieces, and the start of the next.
/// machine.receive(Port::Sensor, &[0xFF, 80, 0xFF, 120], Instant(1_000));
/// machine.receive(Port::Sensor, &[0, 95, 0xFF], Instant(2_000));
/// assert_eq!(machine.sensor().readings, [1_200, 0, 950]);
/// assert_eq!((machine.sensor().counters().frames, machine.sensor().counters().torn), (1, 1));
/// assert_eq!(machine.robot().statistics().scans, 1);
/// # Ok::<(), Box<dyn core::error::Error>>(())
/// ```
pub trait DepthSensor {
    /// Processes bytes that had arrived by `now`, from the front of `bytes`, up to the end of the
    /// next complete frame. `None`: all bytes are used up.
    fn receive(&mut self, bytes: &mut &[u8], now: Instant) -> Option<Scan<'_>>;

    /// Writes the next bytes to the sensor into `out`, which should hold 32 bytes. Returns their
    /// number. By default the sensor takes no commands.
    fn poll_transmit(&mut self, _now: Instant, _out: &mut [u8]) -> Option<usize> {
        None
    }

    /// The latest time for the next call of [`DepthSensor::poll_transmit`].
    fn poll_timeout(&self) -> Instant {
        Instant(u64::MAX)
    }

    /// The driver's counters.
    fn counters(&self) -> SensorCounters;
}
