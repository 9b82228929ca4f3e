//! A serial port or a pseudo-terminal.
//!
//! Reading and writing never block. A peer that accepts no data can block a `write` to the
//! operating system beyond its timeout, so a separate thread writes from a bounded queue.

use std::{
    io::{self, ErrorKind, Read, Write},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    thread,
    time::Duration,
};

/// Capacity of the write queue, in writes of at most 250 bytes each.
const QUEUED_WRITES: usize = 64;

/// Maximum number of bytes per write to the operating system: small enough to be accepted as a
/// whole if there is any room.
const WRITE_CHUNK: usize = 64;

/// Write timeout. It decides how often the writer checks whether the port was dropped while its
/// peer accepts no data, and how long a dropped port waits for queued bytes.
const WRITE_TIMEOUT: Duration = Duration::from_millis(100);

/// The error's text, with advice if the cause is known.
fn told(reason: &serialport::Error) -> String {
    match reason.to_string().as_str() {
        // ENOTTY.
        "Not a typewriter" => "not a serial port; give a device such as /dev/ttyUSB0".into(),
        reason => reason.into(),
    }
}

/// Errors of a serial port.
#[derive(Debug, thiserror::Error)]
pub enum SerialError {
    /// The port could not be opened.
    #[error("{}: {}", path.display(), told(reason))]
    Open {
        /// The port.
        path: PathBuf,
        /// The operating system's error.
        reason: serialport::Error,
    },
    /// The other end is gone: the adapter was unplugged or the pseudo-terminal closed.
    #[error("{}: disconnected; check the cable and the robot", path.display())]
    HungUp {
        /// The port.
        path: PathBuf,
    },
    /// The peer accepts no data and the queue is full; these bytes were not queued.
    #[error("{}: the peer accepts no data", path.display())]
    Stalled {
        /// The port.
        path: PathBuf,
    },
    /// Any other error.
    #[error("{}: {reason}", path.display())]
    Io {
        /// The port.
        path: PathBuf,
        /// The operating system's error.
        reason: io::Error,
    },
}

/// An open serial port: 8 data bits, no parity, 1 stop bit, no flow control.
#[derive(Debug)]
pub struct SerialPort {
    path: PathBuf,
    port: Box<dyn serialport::SerialPort>,
    /// `Some` until the port is dropped.
    writes: Option<mpsc::SyncSender<Vec<u8>>>,
    closing: Arc<AtomicBool>,
    /// Becomes disconnected when the writer thread ends.
    writer: mpsc::Receiver<()>,
}

impl SerialPort {
    /// Opens a port by its path, for exclusive use.
    pub fn open(path: impl AsRef<Path>, baud: u32) -> Result<Self, SerialError> {
        let path = path.as_ref().to_path_buf();
        let opened = serialport::new(path.to_string_lossy(), baud)
            .timeout(WRITE_TIMEOUT)
            .open()
            .and_then(|port| port.try_clone().map(|writer| (port, writer)));
        let (port, writer_port) = match opened {
            Ok(both) => both,
            Err(reason) => return Err(SerialError::Open { path, reason }),
        };
        let closing = Arc::new(AtomicBool::new(false));
        let (writes, queue) = mpsc::sync_channel(QUEUED_WRITES);
        let (alive, writer) = mpsc::channel();
        let spawned = thread::Builder::new().name("serial-write".into()).spawn({
            let closing = Arc::clone(&closing);
            move || {
                write_queued(writer_port, &queue, &closing);
                drop(alive);
            }
        });
        match spawned {
            Ok(_) => Ok(Self { path, port, writes: Some(writes), closing, writer }),
            Err(reason) => Err(SerialError::Io { path, reason }),
        }
    }

    /// Reads bytes that have arrived, without waiting. Returns their number, possibly 0.
    pub fn read(&mut self, buffer: &mut [u8]) -> Result<usize, SerialError> {
        self.read_within(buffer, Duration::ZERO)
    }

    /// Reads bytes that have arrived, and waits up to `wait` for the first one. Returns their
    /// number, possibly 0.
    ///
    /// Bytes that were not read before the other end hung up are lost.
    pub fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, SerialError> {
        if buffer.is_empty() {
            return Ok(0);
        }
        self.port
            .set_timeout(wait)
            .map_err(|reason| SerialError::Io { path: self.path.clone(), reason: reason.into() })?;
        match self.port.read(buffer) {
            Ok(0) => Err(self.hung_up()),
            Ok(count) => Ok(count),
            Err(reason) => match reason.kind() {
                ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted => Ok(0),
                ErrorKind::BrokenPipe | ErrorKind::NotConnected => Err(self.hung_up()),
                _ => Err(SerialError::Io { path: self.path.clone(), reason }),
            },
        }
    }

    /// Queues bytes for writing: all of them or, on error, none. Bytes that are queued when the
    /// port is dropped are still written if the peer accepts them before the write timeout.
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), SerialError> {
        let Some(writes) = &self.writes else { return Err(self.hung_up()) };
        writes.try_send(bytes.to_vec()).map_err(|error| match error {
            mpsc::TrySendError::Full(_) => SerialError::Stalled { path: self.path.clone() },
            mpsc::TrySendError::Disconnected(_) => self.hung_up(),
        })
    }

    fn hung_up(&self) -> SerialError {
        SerialError::HungUp { path: self.path.clone() }
    }
}

impl Drop for SerialPort {
    fn drop(&mut self) {
        self.closing.store(true, Ordering::Relaxed);
        self.writes = None;
        // The thread is not joined: a writer that is blocked in the operating system must not block
        // the owner of the port.
        let _ = self.writer.recv_timeout(WRITE_TIMEOUT);
    }
}

/// Writes queued bytes until the port is dropped or disconnected.
fn write_queued(
    mut port: Box<dyn serialport::SerialPort>,
    queue: &mpsc::Receiver<Vec<u8>>,
    closing: &AtomicBool,
) {
    for bytes in queue {
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            match port.write(&rest[..rest.len().min(WRITE_CHUNK)]) {
                Ok(count) => rest = &rest[count..],
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::TimedOut => {
                    if closing.load(Ordering::Relaxed) {
                        return;
                    }
                }
                Err(_) => return,
            }
        }
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::time::Instant;

    use serialport::{SerialPort as _, TTYPort};

    use super::*;

    /// A port under test at one end of a pseudo-terminal, and the other end.
    fn pair() -> (SerialPort, TTYPort) {
        let (master, slave) = TTYPort::pair().unwrap();
        let path = slave.name().unwrap();
        drop(slave);
        (SerialPort::open(path, 115_200).unwrap(), master)
    }

    #[test]
    fn bytes_of_every_value_cross_both_ways() {
        let (mut port, mut master) = pair();
        let all: Vec<u8> = (0..=255).cycle().take(3_000).collect();

        port.write(&all).unwrap();
        let mut arrived = vec![0; all.len()];
        master.read_exact(&mut arrived).unwrap();
        assert_eq!(arrived, all);

        let mut arrived = Vec::new();
        let mut buffer = [0; 300];
        let writer = thread::spawn({
            let all = all.clone();
            move || {
                master.write_all(&all).unwrap();
                master
            }
        });
        while arrived.len() < all.len() {
            let count = port.read_within(&mut buffer, Duration::from_secs(5)).unwrap();
            assert_ne!(count, 0, "nothing arrived within 5 s");
            arrived.extend_from_slice(&buffer[..count]);
        }
        assert_eq!(arrived, all);
        drop(writer.join());
    }

    #[test]
    fn an_empty_read_returns_immediately() {
        let (mut port, _master) = pair();
        let start = Instant::now();
        assert_eq!(port.read(&mut [0; 8]).unwrap(), 0);
        assert_eq!(port.read(&mut []).unwrap(), 0);
        assert!(start.elapsed() < Duration::from_millis(50));
    }

    #[test]
    fn reads_and_writes_report_a_hang_up() {
        let (mut port, master) = pair();
        drop(master);
        assert!(matches!(port.read(&mut [0; 8]), Err(SerialError::HungUp { .. })));
        let start = Instant::now();
        while !matches!(port.write(b"x"), Err(SerialError::HungUp { .. })) {
            assert!(start.elapsed() < Duration::from_secs(5));
            thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn a_stalled_peer_blocks_neither_writes_nor_dropping() {
        let (mut port, mut master) = pair();
        let start = Instant::now();
        let frame = [0x5A; 250];
        let mut queued = 0;
        // As the other end does not read, first the operating system's buffer (tens of kilobytes)
        // becomes full, then the queue.
        while port.write(&frame).is_ok() {
            queued += frame.len();
            assert!(queued < 10_000_000, "{queued} bytes accepted without a reader");
            thread::sleep(Duration::from_micros(200));
        }
        assert!(matches!(port.write(&frame), Err(SerialError::Stalled { .. })));
        assert_eq!(port.read(&mut [0; 8]).unwrap(), 0);

        // Everything queued arrives once the peer reads, and the next write succeeds.
        let mut arrived = vec![0; queued];
        master.read_exact(&mut arrived).unwrap();
        assert!(arrived.iter().all(|&b| b == 0x5A));
        port.write(b"again").unwrap();
        master.read_exact(&mut arrived[..5]).unwrap();
        assert_eq!(&arrived[..5], b"again");

        while port.write(&frame).is_ok() {
            thread::sleep(Duration::from_micros(200));
        }
        drop(port);
        assert!(start.elapsed() < Duration::from_secs(10));
    }

    #[test]
    fn queued_bytes_are_written_before_the_port_is_dropped() {
        // The slave stays open, because unread bytes are lost at a hang-up.
        let (mut master, slave) = TTYPort::pair().unwrap();
        let mut port = SerialPort::open(slave.name().unwrap(), 115_200).unwrap();
        port.write(&[7; 1_000]).unwrap();
        drop(port);
        let mut arrived = [0; 1_000];
        master.read_exact(&mut arrived).unwrap();
        assert_eq!(arrived, [7; 1_000]);
    }

    #[test]
    fn a_missing_port_is_named() {
        let error = SerialPort::open("/dev/no-such-port", 115_200).unwrap_err();
        assert!(error.to_string().starts_with("/dev/no-such-port: "), "{error}");
    }
}
