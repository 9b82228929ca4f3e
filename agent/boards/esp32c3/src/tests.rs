//! The link in a model of a network: a cable with the robot at one end, and a computer with the server, a
//! DHCP server and a stranger at the other.

use std::{boxed::Box, cell::RefCell, collections::VecDeque, rc::Rc, vec, vec::Vec};

use smoltcp::{
    phy::{DeviceCapabilities, Medium, RxToken, TxToken},
    wire::{DhcpMessageType, DhcpPacket, DhcpRepr, IpAddress, Ipv4Address},
};

use super::*;

const SERVER: Ipv4Address = Ipv4Address::new(10, 0, 0, 1);
const ROBOT: Ipv4Address = Ipv4Address::new(10, 0, 0, 7);
const STRANGER: u16 = 4002;

/// The frames on their way to each end, and whether any arrive.
#[derive(Default)]
struct Cable {
    to: [VecDeque<Vec<u8>>; 2],
    is_up: bool,
}

struct End {
    cable: Rc<RefCell<Cable>>,
    /// 0 is the robot's, 1 the computer's.
    index: usize,
}

struct Received(Vec<u8>);

impl RxToken for Received {
    fn consume<R, F: FnOnce(&[u8]) -> R>(self, read: F) -> R {
        read(&self.0)
    }
}

struct ToSend(Rc<RefCell<Cable>>, usize);

impl TxToken for ToSend {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, len: usize, write: F) -> R {
        let mut frame = vec![0; len];
        let result = write(&mut frame);
        self.0.borrow_mut().to[1 - self.1].push_back(frame);
        result
    }
}

impl Device for End {
    type RxToken<'a> = Received;
    type TxToken<'a> = ToSend;

    fn receive(&mut self, now: time::Instant) -> Option<(Received, ToSend)> {
        let frame = self.cable.borrow_mut().to[self.index].pop_front()?;
        self.transmit(now).map(|reply| (Received(frame), reply))
    }

    fn transmit(&mut self, _: time::Instant) -> Option<ToSend> {
        self.cable.borrow().is_up.then(|| ToSend(self.cable.clone(), self.index))
    }

    fn capabilities(&self) -> DeviceCapabilities {
        let mut capabilities = DeviceCapabilities::default();
        capabilities.medium = Medium::Ethernet;
        capabilities.max_transmission_unit = 1_514;
        capabilities
    }
}

impl Station for End {
    fn address(&self) -> EthernetAddress {
        EthernetAddress([2, 0, 0, 0, 0, self.index as u8])
    }

    fn is_up(&mut self) -> bool {
        self.cable.borrow().is_up
    }
}

/// The computer: UDP sockets of the server, the stranger and the DHCP server.
struct Computer {
    end: End,
    interface: Interface,
    sockets: SocketSet<'static>,
    ports: [SocketHandle; 3],
}

impl Computer {
    fn new(cable: &Rc<RefCell<Cable>>) -> Self {
        let mut end = End { cable: cable.clone(), index: 1 };
        let config = Config::new(end.address().into());
        let mut interface = Interface::new(config, &mut end, time::Instant::ZERO);
        interface.update_ip_addrs(|addresses| {
            addresses.push(IpCidr::new(IpAddress::Ipv4(SERVER), 24)).unwrap();
        });
        let storage: Vec<_> = (0..3).map(|_| SocketStorage::EMPTY).collect();
        let mut sockets = SocketSet::new(storage.leak());
        let ports = [4000, STRANGER, 67].map(|port| {
            let buffer = || {
                let metadata = vec![PacketMetadata::EMPTY; 64].leak();
                PacketBuffer::new(metadata, vec![0; 16_000].leak())
            };
            let mut socket = udp::Socket::new(buffer(), buffer());
            socket.bind(port).unwrap();
            sockets.add(socket)
        });
        Self { end, interface, sockets, ports }
    }

    fn socket(&mut self, index: usize) -> &mut udp::Socket<'static> {
        self.sockets.get_mut(self.ports[index])
    }

    fn poll(&mut self, now: Instant) {
        self.interface.poll(network_time(now), &mut self.end, &mut self.sockets);
        let mut request = [0; 600];
        while let Ok((count, _)) = self.socket(2).recv_slice(&mut request) {
            self.lease(&request[..count]);
        }
    }

    /// Answers a request for an address.
    fn lease(&mut self, request: &[u8]) {
        let packet = DhcpPacket::new_checked(request).unwrap();
        let request = DhcpRepr::parse(&packet).unwrap();
        let message_type = match request.message_type {
            DhcpMessageType::Discover => DhcpMessageType::Offer,
            DhcpMessageType::Request => DhcpMessageType::Ack,
            _ => return,
        };
        let reply = DhcpRepr {
            message_type,
            your_ip: ROBOT,
            server_ip: SERVER,
            router: Some(SERVER),
            subnet_mask: Some(Ipv4Address::new(255, 255, 255, 0)),
            server_identifier: Some(SERVER),
            lease_duration: Some(3_600),
            requested_ip: None,
            client_identifier: None,
            parameter_request_list: None,
            max_size: None,
            ..request
        };
        let mut bytes = vec![0; reply.buffer_len()];
        reply.emit(&mut DhcpPacket::new_unchecked(&mut bytes[..])).unwrap();
        let everybody = IpEndpoint::new(IpAddress::Ipv4(Ipv4Address::BROADCAST), 68);
        self.socket(2).send_slice(&bytes, everybody).unwrap();
    }

    fn send(&mut self, index: usize, bytes: &[u8]) {
        let robot = IpEndpoint::new(IpAddress::Ipv4(ROBOT), LOCAL);
        self.socket(index).send_slice(bytes, robot).unwrap();
    }

    /// The datagrams that have arrived at the server.
    fn received(&mut self) -> Vec<(IpEndpoint, Vec<u8>)> {
        let socket = self.socket(0);
        core::iter::from_fn(|| {
            let (bytes, metadata) = socket.recv().ok()?;
            Some((metadata.endpoint, bytes.to_vec()))
        })
        .collect()
    }
}

struct Network {
    cable: Rc<RefCell<Cable>>,
    link: Link<End>,
    computer: Computer,
    now: Instant,
}

impl Network {
    fn new() -> Self {
        let cable = Rc::new(RefCell::new(Cable::default()));
        let station = End { cable: cable.clone(), index: 0 };
        let server = IpEndpoint::new(IpAddress::Ipv4(SERVER), 4000);
        let buffers = Box::leak(Box::new(Buffers::EMPTY));
        let link = Link::new(station, buffers, server, 5, Instant(0));
        Self { computer: Computer::new(&cable), cable, link, now: Instant(0) }
    }

    fn connect(&self, is_up: bool) {
        *self.cable.borrow_mut() = Cable { is_up, ..Cable::default() };
    }

    /// Lets time pass, in milliseconds. Returns what has become of the link.
    fn run(&mut self, millis: u64) -> Vec<Change> {
        let mut changes = Vec::new();
        for _ in 0..millis {
            while let Some(change) = self.link.poll(self.now) {
                changes.push(change);
            }
            self.computer.poll(self.now);
            self.now = Instant(self.now.0 + 1_000);
        }
        changes
    }

    /// The frames that the robot reads.
    fn read(&mut self) -> Vec<Vec<u8>> {
        let mut frames = Vec::new();
        let mut bytes = [0; DEFAULT_FRAME];
        while !self.link.is_empty() {
            let count = self.link.read(&mut bytes);
            frames.push(bytes[..count].to_vec());
        }
        frames
    }
}

fn address() -> Change {
    Change::Address(Ipv4Cidr::new(ROBOT, 24))
}

#[test]
fn frames_go_both_ways_one_in_a_datagram() {
    let mut network = Network::new();
    network.connect(true);
    assert_eq!(network.run(3_000), [Change::Up, address()]);
    let frames: [&[u8]; 3] = [&[1; DEFAULT_FRAME], &[2], b"three"];
    for frame in frames {
        assert!(network.link.room() >= frame.len());
        network.link.write(frame);
    }
    network.run(100);
    let from = IpEndpoint::new(IpAddress::Ipv4(ROBOT), LOCAL);
    let received = network.computer.received();
    assert_eq!(received, frames.map(|frame| (from, frame.to_vec())));
    for frame in frames {
        network.computer.send(0, frame);
    }
    network.run(100);
    assert_eq!(network.read(), frames);
}

#[test]
fn what_is_from_elsewhere_or_too_long_is_no_frame() {
    let mut network = Network::new();
    network.connect(true);
    network.run(3_000);
    network.computer.send(1, b"stranger");
    network.computer.send(0, &[3; DEFAULT_FRAME + 1]);
    network.computer.send(0, b"frame");
    network.run(100);
    assert_eq!(network.read(), [&b""[..], b"", b"frame"]);
}

#[test]
fn a_link_that_is_down_loses_frames_and_comes_back() {
    let mut network = Network::new();
    // More than the buffers hold: nothing waits for a network.
    for _ in 0..100 {
        assert_eq!(network.link.room(), DEFAULT_FRAME);
        network.link.write(&[4; DEFAULT_FRAME]);
        assert_eq!(network.run(10), []);
    }
    for _ in 0..3 {
        network.connect(true);
        assert_eq!(network.run(3_000), [Change::Up, address()]);
        network.link.write(b"again");
        network.run(100);
        let received = network.computer.received();
        assert_eq!(received.into_iter().map(|(_, frame)| frame).collect::<Vec<_>>(), [b"again"]);
        network.connect(false);
        assert_eq!(network.run(2_000), [Change::Down, Change::NoAddress]);
    }
}

#[test]
fn a_server_that_does_not_answer_makes_the_link_full_and_not_the_robot() {
    let mut network = Network::new();
    network.connect(true);
    network.run(3_000);
    // The computer is gone, but the radio is connected.
    let mut written = 0;
    for _ in 0..100 {
        if network.link.room() >= DEFAULT_FRAME {
            network.link.write(&[5; DEFAULT_FRAME]);
            written += 1;
        }
        while network.link.poll(network.now).is_some() {}
        network.cable.borrow_mut().to[1].clear();
        network.now = Instant(network.now.0 + 1_000);
    }
    assert_eq!(written, WAITING);
    // It is back.
    network.run(3_000);
    assert_eq!(network.computer.received().len(), WAITING);
    assert_eq!(network.link.room(), DEFAULT_FRAME);
}
