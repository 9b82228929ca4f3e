//! Links over UDP: one frame in each datagram, with its delimiter.
//!
//! A [`UdpSocket`] of the server hears many robots, each at an address of its own. A [`UdpLink`] is a
//! robot's end.

use std::{
    io::{self, ErrorKind},
    net::{self, SocketAddr},
    sync::{Arc, OnceLock},
    time::Duration,
};

use super::wire::{Wire, WireError, WireReader, WireWriter};

/// Maximum time for which the operating system may hold up a datagram.
const SEND_TIMEOUT: Duration = Duration::from_millis(2);

/// Buffer for a datagram: larger than any frame.
const MAX_DATAGRAM: usize = 2_048;

/// Ends a frame. Appended to datagrams that lack it, so that a cut one can't damage the next.
const DELIMITER: u8 = 0;

/// The server's socket.
#[derive(Clone, Debug)]
pub struct UdpSocket {
    name: String,
    socket: Arc<net::UdpSocket>,
}

/// The sending end of a link to one robot.
#[derive(Clone, Debug)]
pub struct UdpPeer {
    socket: UdpSocket,
    peer: SocketAddr,
}

/// A link to the robot that knocks first.
#[derive(Clone, Debug)]
struct FirstPeer {
    socket: UdpSocket,
    peer: Arc<OnceLock<SocketAddr>>,
}

/// A robot's end of a link to a server. It hears only the server.
#[derive(Clone, Debug)]
pub struct UdpLink {
    socket: UdpSocket,
}

impl UdpSocket {
    /// Binds a socket to a local address; with port 0, to a free port.
    ///
    /// # Errors
    /// [`WireError::Open`].
    pub fn bind(address: SocketAddr) -> Result<Self, WireError> {
        let name = format!("udp:{address}");
        let opened = net::UdpSocket::bind(address).and_then(|socket| {
            socket.set_write_timeout(Some(SEND_TIMEOUT))?;
            Ok(socket)
        });
        match opened {
            Ok(socket) => Ok(Self { name, socket: Arc::new(socket) }),
            Err(error) => Err(WireError::unbound(name, &error)),
        }
    }

    /// The local address.
    ///
    /// # Errors
    /// The operating system's.
    pub fn local_address(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Receives a datagram, and waits up to `wait` for it: the sender's address and the bytes, which
    /// end with a delimiter.
    ///
    /// # Errors
    /// [`WireError::Io`].
    pub fn receive_within(
        &self,
        wait: Duration,
    ) -> Result<Option<(SocketAddr, Vec<u8>)>, WireError> {
        // Zero would mean for ever.
        let wait = wait.max(Duration::from_micros(1));
        let mut buffer = [0; MAX_DATAGRAM];
        let received = self.socket.set_read_timeout(Some(wait));
        match received.and_then(|()| self.socket.recv_from(&mut buffer)) {
            Ok((count, from)) => {
                let mut bytes = buffer[..count].to_vec();
                if bytes.last().is_some_and(|&last| last != DELIMITER) {
                    bytes.push(DELIMITER);
                }
                Ok(Some((from, bytes)))
            }
            Err(reason) if is_passing(&reason) => Ok(None),
            Err(reason) => Err(WireError::Io { name: self.name.clone(), reason }),
        }
    }

    /// The sending end of the link to a robot.
    pub fn peer(&self, peer: SocketAddr) -> UdpPeer {
        UdpPeer { socket: self.clone(), peer }
    }

    /// Both ends of the link to the first robot that knocks here; others are not heard.
    pub fn into_wire(self) -> Wire {
        let first = FirstPeer { socket: self, peer: Arc::default() };
        Wire { reader: Box::new(first.clone()), writer: Box::new(first) }
    }

    fn sent(&self, sent: io::Result<usize>) -> Result<(), WireError> {
        match sent {
            Ok(_) => Ok(()),
            // A network that is down loses datagrams, as a bad link does.
            Err(reason) if is_passing(&reason) => {
                Err(WireError::Stalled { name: self.name.clone() })
            }
            Err(reason) => Err(WireError::Io { name: self.name.clone(), reason }),
        }
    }
}

impl WireWriter for UdpPeer {
    fn write(&mut self, bytes: &[u8]) -> Result<(), WireError> {
        self.socket.sent(self.socket.socket.send_to(bytes, self.peer))
    }
}

impl WireReader for FirstPeer {
    fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, WireError> {
        let Some((from, bytes)) = self.socket.receive_within(wait)? else { return Ok(0) };
        if *self.peer.get_or_init(|| from) != from {
            return Ok(0);
        }
        let count = bytes.len().min(buffer.len());
        buffer[..count].copy_from_slice(&bytes[..count]);
        Ok(count)
    }
}

impl WireWriter for FirstPeer {
    fn write(&mut self, bytes: &[u8]) -> Result<(), WireError> {
        self.peer.get().map_or(Ok(()), |peer| self.socket.peer(*peer).write(bytes))
    }
}

impl UdpLink {
    /// A link to a server. `local` is the address to send from: one that stays the same lets a
    /// server recognise a robot that has just booted; `None`: any.
    ///
    /// # Errors
    /// [`WireError::Open`].
    pub fn open(server: SocketAddr, local: Option<SocketAddr>) -> Result<Self, WireError> {
        let any = if server.is_ipv4() { [0; 4].into() } else { [0; 16].into() };
        let mut socket = UdpSocket::bind(local.unwrap_or(SocketAddr::new(any, 0)))?;
        socket.name = format!("udp:{server}");
        let connected = socket.socket.connect(server);
        connected.map_err(|reason| WireError::Open {
            name: socket.name.clone(),
            reason: reason.to_string(),
        })?;
        Ok(Self { socket })
    }

    /// Both ends, as those of any link.
    pub fn into_wire(self) -> Wire {
        Wire { reader: Box::new(self.clone()), writer: Box::new(self) }
    }
}

impl WireReader for UdpLink {
    fn read_within(&mut self, buffer: &mut [u8], wait: Duration) -> Result<usize, WireError> {
        let Some((_, bytes)) = self.socket.receive_within(wait)? else { return Ok(0) };
        let count = bytes.len().min(buffer.len());
        buffer[..count].copy_from_slice(&bytes[..count]);
        Ok(count)
    }
}

impl WireWriter for UdpLink {
    fn write(&mut self, bytes: &[u8]) -> Result<(), WireError> {
        self.socket.sent(self.socket.socket.send(bytes))
    }
}

/// Whether an error passes by itself: nothing has arrived, or nobody listens there yet.
fn is_passing(error: &io::Error) -> bool {
    matches!(
        error.kind(),
        ErrorKind::WouldBlock
            | ErrorKind::TimedOut
            | ErrorKind::Interrupted
            | ErrorKind::ConnectionRefused
            | ErrorKind::ConnectionReset
            | ErrorKind::HostUnreachable
            | ErrorKind::NetworkUnreachable
            | ErrorKind::NetworkDown
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const WAIT: Duration = Duration::from_secs(5);

    fn loopback() -> SocketAddr {
        SocketAddr::from(([127, 0, 0, 1], 0))
    }

    #[test]
    fn one_socket_serves_many_robots_and_a_robot_hears_only_its_server() {
        let server = UdpSocket::bind(loopback()).unwrap();
        let address = server.local_address().unwrap();
        let mut links = [(); 3].map(|()| UdpLink::open(address, Some(loopback())).unwrap());
        for (number, link) in links.iter_mut().enumerate() {
            link.write(&[number as u8 + 1, 0]).unwrap();
        }
        let mut buffer = [0; 8];
        for _ in 0..3 {
            let (from, bytes) = server.receive_within(WAIT).unwrap().unwrap();
            assert_eq!(bytes[1..], [0]);
            let link = &mut links[usize::from(bytes[0]) - 1];
            assert_eq!(link.socket.local_address().unwrap(), from);
            let stranger = UdpSocket::bind(loopback()).unwrap();
            stranger.peer(from).write(b"stranger\0").unwrap();
            server.peer(from).write(&[bytes[0], 7, 0]).unwrap();
            assert_eq!(link.read_within(&mut buffer, WAIT).unwrap(), 3);
            assert_eq!(buffer[..3], [bytes[0], 7, 0]);
        }
        assert!(server.receive_within(Duration::ZERO).unwrap().is_none());
    }

    #[test]
    fn a_datagram_without_a_delimiter_gets_one() {
        let server = UdpSocket::bind(loopback()).unwrap();
        let mut link = UdpLink::open(server.local_address().unwrap(), None).unwrap();
        link.write(&[1, 2]).unwrap();
        assert_eq!(server.receive_within(WAIT).unwrap().unwrap().1, [1, 2, 0]);
        link.write(&[]).unwrap();
        assert_eq!(server.receive_within(WAIT).unwrap().unwrap().1, [0; 0]);
    }

    #[test]
    fn a_link_outlives_its_server() {
        let server = UdpSocket::bind(loopback()).unwrap();
        let address = server.local_address().unwrap();
        let mut link = UdpLink::open(address, Some(loopback())).unwrap();
        drop(server);
        for _ in 0..3 {
            assert!(matches!(link.write(b"x\0"), Ok(()) | Err(WireError::Stalled { .. })));
            let read = link.read_within(&mut [0; 8], Duration::from_millis(10));
            assert_eq!(read.unwrap(), 0);
        }
        let server = UdpSocket::bind(address).unwrap();
        while server.receive_within(Duration::from_millis(10)).unwrap().is_none() {
            let _ = link.write(b"x\0");
        }
    }

    #[test]
    fn an_address_of_another_machine_is_refused_by_name() {
        let error = UdpSocket::bind(SocketAddr::from(([192, 0, 2, 1], 4_000))).unwrap_err();
        assert!(error.to_string().starts_with("udp:192.0.2.1:4000: "), "{error}");
    }
}
