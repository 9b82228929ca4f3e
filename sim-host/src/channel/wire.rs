//! A byte stream to and from a robot.

use std::time::Duration;

use super::serial::{SerialError, SerialPort};

/// A byte stream to and from a robot, such as a serial port.
pub trait Wire {
    /// Reads bytes that have arrived, and waits up to `wait` for the first one. Returns their
    /// number, possibly 0.
    ///
    /// # Errors
    /// Any [`SerialError`] except `Stalled`; the wire can then no longer be used.
    fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, SerialError>;

    /// Queues bytes, all or none.
    ///
    /// # Errors
    /// [`SerialError::Stalled`] if there is no room now; after any other error the wire can no
    /// longer be used.
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
