//! A robot at three serial ports, in real time.

use std::{path::PathBuf, str::FromStr, time};

use ubimap_protocol::time::{Duration, Instant};

use super::link::{BAUD, Link, PortBytes};
use crate::channel::{serial::SerialPort, wire::WireError};

/// Bytes read at once.
const CHUNK: usize = 512;

/// Maximum time for which a turn waits for bytes from the robot.
const MAX_WAIT: time::Duration = time::Duration::from_micros(500);

/// The serial ports of a robot outside, as `SERVER,SENSOR,WHEELS`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Paths {
    /// The robot's port to the server.
    pub server: PathBuf,
    /// Its port to an A010.
    pub sensor: PathBuf,
    /// Its port to a Create 2.
    pub wheels: PathBuf,
}

/// The text does not name three ports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("must be three ports, SERVER,SENSOR,WHEELS")]
pub struct NotThreePorts;

impl FromStr for Paths {
    type Err = NotThreePorts;

    fn from_str(text: &str) -> Result<Self, NotThreePorts> {
        let parts: Vec<&str> = text.split(',').map(str::trim).collect();
        let [server, sensor, wheels] = parts[..] else { return Err(NotThreePorts) };
        let [server, sensor, wheels] = [server, sensor, wheels].map(PathBuf::from);
        Ok(Self { server, sensor, wheels })
    }
}

/// The open ports.
pub(super) struct SerialPorts {
    server: SerialPort,
    sensor: SerialPort,
    wheels: SerialPort,
    /// When the run began.
    began: time::Instant,
    /// How far the simulation was behind real time at most.
    late: Duration,
}

impl SerialPorts {
    /// Opens the ports.
    ///
    /// # Errors
    /// [`WireError::Open`].
    pub(super) fn open(paths: &Paths) -> Result<Self, WireError> {
        Ok(Self {
            server: SerialPort::open(&paths.server, BAUD)?,
            sensor: SerialPort::open(&paths.sensor, BAUD)?,
            wheels: SerialPort::open(&paths.wheels, BAUD)?,
            began: time::Instant::now(),
            late: Duration::default(),
        })
    }

    fn now(&self) -> Instant {
        Instant(self.began.elapsed().as_micros() as u64)
    }
}

impl Link for SerialPorts {
    fn receive(&mut self, until: Instant) -> Result<(Instant, PortBytes), WireError> {
        self.late = self.late.max(self.now().since(until));
        let left = time::Duration::from_micros(until.since(self.now()).micros()).min(MAX_WAIT);
        let mut bytes = [0; CHUNK];
        let count = self.wheels.read_within(&mut bytes, left)?;
        let wheels = bytes[..count].to_vec();
        // The simulation may be late; its events are then caught up with one after the other.
        let now = self.now().min(until);
        let mut read = |port: &mut SerialPort| {
            let count = port.read(&mut bytes)?;
            Ok(bytes[..count].to_vec())
        };
        Ok((now, [read(&mut self.server)?, read(&mut self.sensor)?, wheels]))
    }

    fn send(&mut self, [sensor, wheels]: [Vec<u8>; 2]) -> Result<(), WireError> {
        send(&mut self.sensor, &sensor)?;
        send(&mut self.wheels, &wheels)
    }

    fn transmit(&mut self, frame: &[u8], _: Instant) -> Result<(), WireError> {
        send(&mut self.server, frame)
    }

    fn late(&self) -> Option<Duration> {
        Some(self.late)
    }
}

/// Writes bytes to a port. A robot that accepts none loses them, as on a line without flow control.
fn send(port: &mut SerialPort, bytes: &[u8]) -> Result<(), WireError> {
    if bytes.is_empty() {
        return Ok(());
    }
    match port.write(bytes) {
        Err(WireError::Stalled { .. }) => Ok(()),
        other => other,
    }
}
