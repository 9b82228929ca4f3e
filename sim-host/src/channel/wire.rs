//! A byte stream to and from a robot.

use std::time::Duration;

use super::serial::{SerialError, SerialPort};

/// A byte stream to and from a robot, such as a serial port.
pub trait Wire {
    /// Reads the bytes that have arrived, waiting up to `wait` for the first one. Returns their number.
    ///
    /// # Errors
    /// Any [`SerialError`] but `Stalled`; the wire is then of no further use.
    fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, SerialError>;

    /// Queues bytes, all or none.
    ///
    /// # Errors
    /// [`SerialError::Stalled`] if there is no room now; after any other error the wire is of no
    /// further use.
    fn write(&mut self, bytes: &[u8]) -> Result<(), SerialError>;
}

impl Wire for SerialPort {
    fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, SerialError> {
        Self::read_within(self, buffer, wait)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), SerialError> {
        Self::write(self, bytes)
    }
}
