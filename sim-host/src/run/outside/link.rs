//! How the bytes of a robot outside arrive.

use ubimap_protocol::time::{Duration, Instant};

use crate::channel::wire::WireError;

/// Speed of all three ports in bits per second.
pub(super) const BAUD: u32 = 115_200;

/// Bytes at each port: to the server, the sensor and the wheels.
pub(super) type PortBytes = [Vec<u8>; 3];

/// How the bytes of a robot's ports arrive, and whose time is the simulation's.
pub(super) trait Link {
    /// Waits for bytes of the robot, until `until` at the latest. Returns the time, and the bytes.
    ///
    /// # Errors
    /// The robot has hung up.
    fn receive(&mut self, until: Instant) -> Result<(Instant, PortBytes), WireError>;

    /// Sends what the devices have sent by the time that [`Link::receive`] returned last: the sensor and the wheels.
    ///
    /// # Errors
    /// The robot has hung up.
    fn send(&mut self, devices: [Vec<u8>; 2]) -> Result<(), WireError>;

    /// Sends a frame of the server at `now`.
    ///
    /// # Errors
    /// The robot has hung up.
    fn transmit(&mut self, frame: &[u8], now: Instant) -> Result<(), WireError>;

    /// How far the simulation was behind real time at most, if the robot's time is real.
    fn late(&self) -> Option<Duration>;
}
