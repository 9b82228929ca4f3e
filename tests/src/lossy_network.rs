//! A network between robots and a server: a test makes it lose, double and reorder datagrams.

use std::{
    collections::BTreeMap,
    io,
    net::{SocketAddr, UdpSocket},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Time between two looks at the sockets.
const PERIOD: Duration = Duration::from_micros(500);
/// By how much a datagram that others overtake is held up.
const HELD_UP: Duration = Duration::from_millis(30);
/// The shares of datagrams that are lost, doubled and held up while the network is bad.
const LOST: f64 = 0.3;
const DOUBLED: f64 = 0.1;
const OVERTAKEN: f64 = 0.1;

/// A network with one server.
pub struct LossyNetwork {
    address: SocketAddr,
    shared: Arc<Shared>,
    carrier: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    is_bad: AtomicBool,
    has_ended: AtomicBool,
}

/// Both ends of a robot's way to the server.
struct Way {
    robot: SocketAddr,
    to_server: UdpSocket,
}

/// A datagram that is held up.
struct Late {
    due: Instant,
    robot: SocketAddr,
    to_server: bool,
    bytes: Vec<u8>,
}

impl LossyNetwork {
    /// A network to the server at this port of the machine; `seed` is that of its faults.
    ///
    /// # Errors
    /// There is no free port.
    pub fn new(server: u16, seed: u64) -> io::Result<Self> {
        let robots = UdpSocket::bind("127.0.0.1:0")?;
        robots.set_nonblocking(true)?;
        let address = robots.local_addr()?;
        let shared = Arc::<Shared>::default();
        let carrier = thread::spawn({
            let shared = Arc::clone(&shared);
            move || Carrier::new(robots, server, seed).carry(&shared)
        });
        Ok(Self { address, shared, carrier: Some(carrier) })
    }

    /// Where robots reach the server.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Makes the network bad, or good again.
    pub fn set_bad(&self, is_bad: bool) {
        self.shared.is_bad.store(is_bad, Ordering::Relaxed);
    }
}

impl Drop for LossyNetwork {
    fn drop(&mut self) {
        self.shared.has_ended.store(true, Ordering::Relaxed);
        let _ = self.carrier.take().map(JoinHandle::join);
    }
}

struct Carrier {
    robots: UdpSocket,
    server: u16,
    ways: BTreeMap<SocketAddr, Way>,
    late: Vec<Late>,
    dice: ChaCha8Rng,
}

impl Carrier {
    fn new(robots: UdpSocket, server: u16, seed: u64) -> Self {
        let dice = ChaCha8Rng::seed_from_u64(seed);
        Self { robots, server, ways: BTreeMap::new(), late: Vec::new(), dice }
    }

    fn carry(mut self, shared: &Shared) {
        let mut buffer = [0; 2_048];
        while !shared.has_ended.load(Ordering::Relaxed) {
            let is_bad = shared.is_bad.load(Ordering::Relaxed);
            while let Ok((count, robot)) = self.robots.recv_from(&mut buffer) {
                self.pass(robot, true, &buffer[..count], is_bad);
            }
            let ways: Vec<SocketAddr> = self.ways.keys().copied().collect();
            for robot in ways {
                // A server that is away refuses.
                while let Ok(count) = self.ways[&robot].to_server.recv(&mut buffer) {
                    self.pass(robot, false, &buffer[..count], is_bad);
                }
            }
            let now = Instant::now();
            let due: Vec<Late> = self.late.extract_if(.., |late| late.due <= now).collect();
            for Late { robot, to_server, bytes, .. } in due {
                self.deliver(robot, to_server, &bytes);
            }
            thread::sleep(PERIOD);
        }
    }

    fn pass(&mut self, robot: SocketAddr, to_server: bool, bytes: &[u8], is_bad: bool) {
        let mut happens = |share: f64| is_bad && self.dice.random_bool(share);
        let (lost, doubled, overtaken) = (happens(LOST), happens(DOUBLED), happens(OVERTAKEN));
        if lost {
            return;
        }
        if overtaken || doubled {
            let due = Instant::now() + HELD_UP;
            self.late.push(Late { due, robot, to_server, bytes: bytes.to_vec() });
        }
        if !overtaken {
            self.deliver(robot, to_server, bytes);
        }
    }

    fn deliver(&mut self, robot: SocketAddr, to_server: bool, bytes: &[u8]) {
        if !self.ways.contains_key(&robot)
            && let Ok(way) = Way::open(robot, self.server)
        {
            self.ways.insert(robot, way);
        }
        let Some(way) = self.ways.get(&robot) else { return };
        // What can't be delivered is lost.
        let _ = if to_server {
            way.to_server.send(bytes)
        } else {
            self.robots.send_to(bytes, way.robot)
        };
    }
}

impl Way {
    fn open(robot: SocketAddr, server: u16) -> io::Result<Self> {
        let to_server = UdpSocket::bind("127.0.0.1:0")?;
        to_server.connect(("127.0.0.1", server))?;
        to_server.set_nonblocking(true)?;
        Ok(Self { robot, to_server })
    }
}
