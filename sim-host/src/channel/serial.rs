//! A serial port or a pseudo-terminal. Neither end ever blocks beyond the wait that is asked for.

use std::{
    io::{ErrorKind, Read},
    path::Path,
    time::Duration,
};

use super::{
    wire::{Wire, WireError, WireReader, WireWriter},
    write_queue::{WRITE_TIMEOUT, WriteQueue},
};

/// Maximum number of bytes per write to the operating system: small enough to be accepted as a
/// whole if there is any room.
const WRITE_CHUNK: usize = 64;

/// The error's text, with advice if the cause is known.
fn told(reason: &serialport::Error) -> String {
    use serialport::ErrorKind::{Io, NoDevice};
    let text = reason.to_string();
    match reason.kind() {
        Io(ErrorKind::NotFound) => format!("{text}; ubimap ports lists what is connected"),
        Io(ErrorKind::PermissionDenied) => format!(
            "{text}; join the group that owns the port (on most Linux systems: sudo usermod -aG dialout $USER), and log in again"
        ),
        _ if text.contains("exclusive lock") || text.contains("busy") => {
            "busy: another program has it open (fuser -v names it)".into()
        }
        // ENOTTY.
        _ if text == "Not a typewriter" => {
            "not a serial port; give a device such as /dev/ttyUSB0".into()
        }
        NoDevice => format!("{text}; unplug it and plug it in again"),
        // EIO.
        _ if text == "I/O error" => "no hardware answers behind this name".into(),
        _ => text,
    }
}

/// A serial port of this computer, whatever is connected to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ListedPort {
    /// Its path.
    pub path: String,
    /// What the operating system knows of it: a USB device's names and serial number, or the kind of port.
    pub what: String,
}

/// The serial ports of this computer, in the order of their paths. Pseudo-terminals are not listed.
///
/// # Errors
/// The operating system's reason.
pub fn list() -> Result<Vec<ListedPort>, String> {
    // The library panics without this folder, as in some containers.
    if cfg!(target_os = "linux") && !Path::new("/sys/class/tty").is_dir() {
        return Ok(Vec::new());
    }
    let ports = serialport::available_ports().map_err(|error| error.to_string())?;
    let mut listed: Vec<ListedPort> = ports
        .into_iter()
        .map(|port| ListedPort { path: port.port_name, what: described(port.port_type) })
        .collect();
    listed.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(listed)
}

fn described(kind: serialport::SerialPortType) -> String {
    use serialport::SerialPortType::{BluetoothPort, PciPort, Unknown, UsbPort};
    match kind {
        UsbPort(usb) => {
            let names: Vec<String> =
                [usb.manufacturer, usb.product].into_iter().flatten().collect();
            let name = if names.is_empty() {
                format!("{:04x}:{:04x}", usb.vid, usb.pid)
            } else {
                names.join(" ")
            };
            let number = usb.serial_number.map_or(String::new(), |it| format!(", number {it}"));
            format!("USB, {name}{number}")
        }
        PciPort => "built in".into(),
        BluetoothPort => "Bluetooth".into(),
        Unknown => "serial port".into(),
    }
}

/// An open serial port: 8 data bits, no parity, 1 stop bit, no flow control.
#[derive(Debug)]
pub struct SerialPort {
    reader: SerialReader,
    writer: WriteQueue,
}

/// The receiving end of a serial port.
#[derive(Debug)]
pub struct SerialReader {
    name: String,
    port: Box<dyn serialport::SerialPort>,
}

impl SerialPort {
    /// Opens a port by its path, for exclusive use.
    ///
    /// # Errors
    /// [`WireError::Open`], and [`WireError::Io`] if no thread can be started.
    pub fn open(path: impl AsRef<Path>, baud: u32) -> Result<Self, WireError> {
        let name = path.as_ref().display().to_string();
        let opened = serialport::new(path.as_ref().to_string_lossy(), baud)
            .timeout(WRITE_TIMEOUT)
            .open()
            .and_then(|port| port.try_clone().map(|writer| (port, writer)));
        let (port, stream) = match opened {
            Ok(both) => both,
            Err(reason) => return Err(WireError::Open { name, reason: told(&reason) }),
        };
        let writer = WriteQueue::start(name.clone(), stream, WRITE_CHUNK)?;
        Ok(Self { reader: SerialReader { name, port }, writer })
    }

    /// Both ends, for different threads.
    pub fn split(self) -> (SerialReader, WriteQueue) {
        (self.reader, self.writer)
    }

    /// Both ends, as those of any link.
    pub fn into_wire(self) -> Wire {
        Wire { reader: Box::new(self.reader), writer: Box::new(self.writer) }
    }

    /// Reads bytes that have arrived, without waiting. Returns their number, possibly 0.
    ///
    /// # Errors
    /// As [`SerialPort::read_within`].
    pub fn read(&mut self, buffer: &mut [u8]) -> Result<usize, WireError> {
        self.read_within(buffer, Duration::ZERO)
    }

    /// Reads bytes that have arrived, and waits up to `wait` for the first one. Returns their
    /// number, possibly 0.
    ///
    /// # Errors
    /// Any [`WireError`] except `Stalled`.
    pub fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, WireError> {
        self.reader.read_within(buffer, wait)
    }

    /// Queues bytes for writing: all of them or, on error, none. Bytes that are queued when the
    /// port is dropped are still written if the peer accepts them before the write timeout.
    ///
    /// # Errors
    /// [`WireError::Stalled`] if the queue is full, or [`WireError::HungUp`].
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), WireError> {
        self.writer.write(bytes)
    }
}

impl WireReader for SerialReader {
    /// Bytes that were not read before the other end hung up are lost.
    fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, WireError> {
        if buffer.is_empty() {
            return Ok(0);
        }
        let hung_up = || WireError::HungUp { name: self.name.clone() };
        let io = |reason| WireError::Io { name: self.name.clone(), reason };
        self.port.set_timeout(wait).map_err(|reason| io(reason.into()))?;
        match self.port.read(buffer) {
            Ok(0) => Err(hung_up()),
            Ok(count) => Ok(count),
            Err(reason) => match reason.kind() {
                ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted => Ok(0),
                ErrorKind::BrokenPipe | ErrorKind::NotConnected => Err(hung_up()),
                _ => Err(io(reason)),
            },
        }
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::{io::Write, thread, time::Instant};

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
        assert!(matches!(port.read(&mut [0; 8]), Err(WireError::HungUp { .. })));
        let start = Instant::now();
        while !matches!(port.write(b"x"), Err(WireError::HungUp { .. })) {
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
        assert!(matches!(port.write(&frame), Err(WireError::Stalled { .. })));
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
