//! Links over TCP: a listener, and a stream of frames on each connection.

use std::{
    io::{self, ErrorKind, Read},
    net::{self, SocketAddr, TcpStream},
    thread,
    time::Duration,
};

use super::{
    wire::{Wire, WireError, WireReader},
    write_queue::{WRITE_TIMEOUT, WriteQueue},
};

/// Interval between two looks for a new connection.
const ACCEPT_INTERVAL: Duration = Duration::from_millis(10);

/// A listener for connections of robots.
#[derive(Debug)]
pub struct TcpListener {
    name: String,
    listener: net::TcpListener,
}

impl TcpListener {
    /// Listens at a local address; with port 0, at a free port.
    ///
    /// # Errors
    /// [`WireError::Open`].
    pub fn bind(address: SocketAddr) -> Result<Self, WireError> {
        let name = format!("tcp:{address}");
        let opened = net::TcpListener::bind(address).and_then(|listener| {
            listener.set_nonblocking(true)?;
            Ok(listener)
        });
        match opened {
            Ok(listener) => Ok(Self { name, listener }),
            Err(error) => Err(WireError::unbound(name, &error)),
        }
    }

    /// The local address.
    ///
    /// # Errors
    /// The operating system's.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// Waits up to `wait` for a connection.
    ///
    /// # Errors
    /// [`WireError::Io`].
    pub fn accept_within(
        &self,
        wait: Duration,
    ) -> Result<Option<(TcpStream, SocketAddr)>, WireError> {
        let mut left = wait;
        loop {
            match self.listener.accept() {
                Ok(connection) => return Ok(Some(connection)),
                Err(error) => match error.kind() {
                    // The peer was gone before it was accepted.
                    ErrorKind::WouldBlock
                    | ErrorKind::Interrupted
                    | ErrorKind::ConnectionAborted => {}
                    _ => return Err(WireError::Io { name: self.name.clone(), reason: error }),
                },
            }
            if left.is_zero() {
                return Ok(None);
            }
            let nap = left.min(ACCEPT_INTERVAL);
            thread::sleep(nap);
            left -= nap;
        }
    }
}

/// The receiving end of a connection.
#[derive(Debug)]
struct TcpReader {
    name: String,
    stream: TcpStream,
}

/// Both ends of a connection. `name` is used in messages.
///
/// # Errors
/// [`WireError::Io`].
pub fn wire(stream: TcpStream, name: String) -> Result<Wire, WireError> {
    let prepared = || {
        stream.set_nonblocking(false)?;
        stream.set_nodelay(true)?;
        stream.set_write_timeout(Some(WRITE_TIMEOUT))?;
        stream.try_clone()
    };
    let writer = prepared().map_err(|reason| WireError::Io { name: name.clone(), reason })?;
    let writer = WriteQueue::start(name.clone(), writer, usize::MAX)?;
    Ok(Wire { reader: Box::new(TcpReader { name, stream }), writer: Box::new(writer) })
}

/// A robot's end of a connection to a server.
///
/// # Errors
/// [`WireError::Open`] if nobody listens there.
pub fn connect(server: SocketAddr, wait: Duration) -> Result<Wire, WireError> {
    let name = format!("tcp:{server}");
    match TcpStream::connect_timeout(&server, wait) {
        Ok(stream) => wire(stream, name),
        Err(reason) => Err(WireError::Open { name, reason: reason.to_string() }),
    }
}

impl WireReader for TcpReader {
    fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, WireError> {
        if buffer.is_empty() {
            return Ok(0);
        }
        let hung_up = || WireError::HungUp { name: self.name.clone() };
        // Zero would mean for ever.
        let wait = wait.max(Duration::from_micros(1));
        let read = self.stream.set_read_timeout(Some(wait));
        match read.and_then(|()| self.stream.read(buffer)) {
            Ok(0) => Err(hung_up()),
            Ok(count) => Ok(count),
            Err(reason) => match reason.kind() {
                ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted => Ok(0),
                ErrorKind::ConnectionReset | ErrorKind::BrokenPipe => Err(hung_up()),
                _ => Err(WireError::Io { name: self.name.clone(), reason }),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WAIT: Duration = Duration::from_secs(5);

    /// A connection: the robot's end, and the server's.
    fn pair() -> (Wire, Wire) {
        let listener = TcpListener::bind(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
        assert!(listener.accept_within(Duration::ZERO).unwrap().is_none());
        let robot = connect(listener.local_address().unwrap(), WAIT).unwrap();
        let (stream, _) = listener.accept_within(WAIT).unwrap().unwrap();
        (robot, wire(stream, "the server".into()).unwrap())
    }

    #[test]
    fn bytes_cross_both_ways_and_a_hang_up_is_reported() {
        let (mut robot, mut server) = pair();
        let mut buffer = [0; 300];
        robot.writer.write(b"hello\0").unwrap();
        assert_eq!(server.reader.read_within(&mut buffer, WAIT).unwrap(), 6);
        server.writer.write(b"welcome\0").unwrap();
        assert_eq!(robot.reader.read_within(&mut buffer, WAIT).unwrap(), 8);
        assert_eq!(&buffer[..8], b"welcome\0");
        assert_eq!(server.reader.read_within(&mut buffer, Duration::ZERO).unwrap(), 0);
        drop(robot);
        let error = server.reader.read_within(&mut buffer, WAIT).unwrap_err();
        assert_eq!(error.to_string(), "the server: disconnected; check the cable and the robot");
    }

    #[test]
    fn a_peer_that_does_not_read_stalls_the_link_and_nothing_else() {
        let (robot, mut server) = pair();
        let mut queued = 0;
        while server.writer.write(&[7; 250]).is_ok() {
            queued += 250;
            assert!(queued < 100_000_000, "{queued} bytes accepted without a reader");
            thread::sleep(Duration::from_micros(20));
        }
        assert!(matches!(server.writer.write(&[7]), Err(WireError::Stalled { .. })));
        drop(server);
        drop(robot);
    }
}
