//! The link to the server: UDP, with one frame in each datagram. The robot's address is from DHCP.
//!
//! Nothing here is the chip's, so a computer runs its tests.
#![no_std]

#[cfg(test)]
extern crate std;

#[cfg(test)]
mod tests;

use smoltcp::{
    iface::{Config, Interface, SocketHandle, SocketSet, SocketStorage},
    phy::Device,
    socket::{
        dhcpv4::{self, Event},
        udp::{self, PacketBuffer, PacketMetadata},
    },
    time,
    wire::{EthernetAddress, IpCidr, IpEndpoint, Ipv4Cidr},
};
use ubimap_protocol::{frame::DEFAULT_FRAME, time::Instant};

/// A radio that carries Ethernet frames while it is connected to a network.
pub trait Station: Device {
    /// Its hardware address.
    fn address(&self) -> EthernetAddress;

    /// Whether it is connected.
    fn is_up(&mut self) -> bool;
}

/// What has become of the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// The station is connected.
    Up,
    /// The station is not connected any more.
    Down,
    /// The robot has an address.
    Address(Ipv4Cidr),
    /// The robot has lost its address.
    NoAddress,
}

/// The port that the robot sends from: always the same, so that the server welcomes a robot that has just
/// booted at once.
const LOCAL: u16 = 4101;

/// Number of datagrams that wait to be read, and to be sent.
const WAITING: usize = 8;

/// The memory of a link.
pub struct Buffers {
    sockets: [SocketStorage<'static>; 2],
    metadata: [[PacketMetadata; WAITING]; 2],
    bytes: [[u8; WAITING * DEFAULT_FRAME]; 2],
}

impl Buffers {
    pub const EMPTY: Self = Self {
        sockets: [SocketStorage::EMPTY; 2],
        metadata: [[PacketMetadata::EMPTY; WAITING]; 2],
        bytes: [[0; WAITING * DEFAULT_FRAME]; 2],
    };
}

/// The link to the server.
pub struct Link<S> {
    station: S,
    interface: Interface,
    sockets: SocketSet<'static>,
    udp: SocketHandle,
    dhcp: SocketHandle,
    server: IpEndpoint,
    is_up: bool,
}

impl<S: Station> Link<S> {
    /// The link to a server. `seed` is random.
    pub fn new(
        mut station: S,
        buffers: &'static mut Buffers,
        server: IpEndpoint,
        seed: u32,
        now: Instant,
    ) -> Self {
        let mut config = Config::new(station.address().into());
        config.random_seed = seed.into();
        let interface = Interface::new(config, &mut station, network_time(now));
        let mut sockets = SocketSet::new(&mut buffers.sockets[..]);
        let [received, queued] = &mut buffers.bytes;
        let [received_at, queued_at] = &mut buffers.metadata;
        let mut socket = udp::Socket::new(
            PacketBuffer::new(&mut received_at[..], &mut received[..]),
            PacketBuffer::new(&mut queued_at[..], &mut queued[..]),
        );
        // It fails on port 0, and on a socket that is open already.
        let _ = socket.bind(LOCAL);
        let udp = sockets.add(socket);
        let dhcp = sockets.add(dhcpv4::Socket::new());
        Self { station, interface, sockets, udp, dhcp, server, is_up: false }
    }

    /// Receives and sends what is due. Call it until it tells no change.
    pub fn poll(&mut self, now: Instant) -> Option<Change> {
        let is_up = self.station.is_up();
        if is_up != self.is_up {
            self.is_up = is_up;
            // Another network may have other addresses.
            self.sockets.get_mut::<dhcpv4::Socket<'_>>(self.dhcp).reset();
            return Some(if is_up { Change::Up } else { Change::Down });
        }
        self.interface.poll(network_time(now), &mut self.station, &mut self.sockets);
        let routes = self.interface.routes_mut();
        match self.sockets.get_mut::<dhcpv4::Socket<'_>>(self.dhcp).poll()? {
            Event::Configured(config) => {
                routes.remove_default_ipv4_route();
                if let Some(router) = config.router {
                    let _ = routes.add_default_ipv4_route(router);
                }
                self.interface.update_ip_addrs(|addresses| {
                    addresses.clear();
                    let _ = addresses.push(IpCidr::Ipv4(config.address));
                });
                Some(Change::Address(config.address))
            }
            Event::Deconfigured => {
                routes.remove_default_ipv4_route();
                let had_address = self.interface.ipv4_addr().is_some();
                self.interface.update_ip_addrs(|addresses| addresses.clear());
                had_address.then_some(Change::NoAddress)
            }
        }
    }

    fn socket(&mut self) -> &mut udp::Socket<'static> {
        self.sockets.get_mut(self.udp)
    }

    /// Whether nothing of the server waits to be read.
    pub fn is_empty(&mut self) -> bool {
        !self.socket().can_recv()
    }

    /// Reads a frame of the server. Returns its number of bytes.
    pub fn read(&mut self, bytes: &mut [u8]) -> usize {
        let server = self.server;
        // What is from elsewhere or too long for a frame is dropped.
        match self.socket().recv_slice(bytes) {
            Ok((count, metadata)) if metadata.endpoint == server => count,
            _ => 0,
        }
    }

    /// Number of bytes that [`Link::write`] accepts now. Without an address everything is accepted, and lost,
    /// as it is by a serial port without a server.
    pub fn room(&mut self) -> usize {
        if !self.has_address() || self.socket().can_send() { DEFAULT_FRAME } else { 0 }
    }

    /// Sends a frame.
    pub fn write(&mut self, frame: &[u8]) {
        let server = self.server;
        if self.has_address() {
            let _ = self.socket().send_slice(frame, server);
        }
    }

    fn has_address(&self) -> bool {
        self.is_up && self.interface.ipv4_addr().is_some()
    }
}

fn network_time(now: Instant) -> time::Instant {
    time::Instant::from_micros(now.micros() as i64)
}
