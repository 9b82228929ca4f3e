//! All links of a server: ports that it opens, and sockets at which robots knock.

use std::{net::SocketAddr, time};

use log::Level;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::{attached::Attached, message::Message};
use crate::{
    channel::{
        address::Address,
        intake::{Arrival, Feed, Intake, Listening, SourceId, What},
        tcp::{self, TcpListener},
        udp::UdpSocket,
        wire::WireError,
    },
    deployment::{Deployment, Policy, PortId},
};

/// Maximum number of peers of a socket at once. Beyond it the stranger that was silent for longest
/// makes room.
const MAX_PEERS: usize = 1_024;

/// Time after which a silent peer of a socket is closed: one with a session, and a stranger.
const ROBOT_SILENT: Duration = Duration::from_secs(30);
const STRANGER_SILENT: Duration = Duration::from_secs(5);

/// A socket at which robots knock.
#[derive(Debug)]
pub struct Door {
    address: Address,
    socket: Socket,
    /// The pose of the robots behind it, if known.
    stands: Option<Pose>,
}

#[derive(Debug)]
enum Socket {
    Udp(UdpSocket),
    /// `None` once a thread listens.
    Tcp(Option<TcpListener>),
}

impl Door {
    /// Opens a socket; `None` for the address of a serial port.
    ///
    /// # Errors
    /// [`WireError::Open`].
    pub fn open(address: &Address, stands: Option<Pose>) -> Result<Option<Self>, WireError> {
        let socket = match *address {
            Address::Serial(_) => return Ok(None),
            Address::Udp(address) => Socket::Udp(UdpSocket::bind(address)?),
            Address::Tcp(address) => Socket::Tcp(Some(TcpListener::bind(address)?)),
        };
        Ok(Some(Self { address: address.clone(), socket, stands }))
    }
}

/// A link, and its port at the deployment. A wire that was opened again has a new port.
struct Link {
    port: PortId,
    attached: Attached,
    /// The socket and the address of a datagram's sender.
    peer: Option<(SourceId, SocketAddr)>,
    heard: Instant,
}

/// All links.
pub(super) struct Links {
    intake: Intake<Message>,
    doors: Vec<(Door, Listening)>,
    links: Vec<Link>,
    /// How robots' reports are logged.
    level: Level,
    /// What all ports require.
    policy: Policy,
}

impl Links {
    /// Opens a port of the deployment for each link, and listens. What robots report is logged at
    /// `level`.
    ///
    /// # Errors
    /// [`WireError::Io`] if no thread can be started.
    pub(super) fn open(
        attached: Vec<Attached>,
        doors: Vec<Door>,
        policy: Policy,
        deployment: &mut Deployment,
        level: Level,
    ) -> Result<Self, WireError> {
        let intake = Intake::default();
        let mut links = Self { intake, doors: Vec::new(), links: Vec::new(), level, policy };
        for attached in attached {
            links.add(attached, None, deployment, Instant(0))?;
        }
        for mut door in doors {
            let listening = match &mut door.socket {
                Socket::Udp(socket) => Some(links.intake.udp(socket.clone())?),
                Socket::Tcp(listener) => {
                    listener.take().map(|it| links.intake.tcp(it)).transpose()?
                }
            };
            links.doors.extend(listening.map(|listening| (door, listening)));
        }
        Ok(links)
    }

    fn add(
        &mut self,
        mut attached: Attached,
        peer: Option<(SourceId, SocketAddr)>,
        deployment: &mut Deployment,
        heard: Instant,
    ) -> Result<(), WireError> {
        attached.listen(&mut self.intake)?;
        let port = deployment.open_port(self.policy);
        self.links.push(Link { port, attached, peer, heard });
        Ok(())
    }

    /// Whether any link or socket is open.
    pub(super) fn is_open(&self) -> bool {
        !self.doors.is_empty() || self.links.iter().any(|link| link.attached.is_open())
    }

    /// The links with their ports.
    pub(super) fn iter(&self) -> impl Iterator<Item = (PortId, &Attached)> {
        self.links.iter().map(|link| (link.port, &link.attached))
    }

    /// The robots that were heard: the name of the port, and when bytes last arrived there.
    pub(super) fn robots(&self) -> impl Iterator<Item = (RobotId, &str, Instant)> {
        self.links
            .iter()
            .filter_map(|link| Some((link.attached.robot()?, link.attached.name(), link.heard)))
    }

    /// What other threads send messages with.
    pub(super) fn feed(&self) -> Feed<Message> {
        self.intake.feed()
    }

    /// The oldest arrival; waits up to `wait` for one.
    pub(super) fn next_within(&self, wait: time::Duration) -> Option<Arrival<Message>> {
        self.intake.next_within(wait)
    }

    /// Passes what has arrived at a port on to the deployment. `at` is its time since the start.
    pub(super) fn take(
        &mut self,
        source: SourceId,
        what: What,
        deployment: &mut Deployment,
        at: Instant,
    ) {
        let index = match &what {
            What::Datagram(from, _) => self.peer(source, *from, deployment, at),
            What::Connection(..) => None,
            _ => self.links.iter().position(|link| link.attached.source() == Some(source)),
        };
        let link = index.and_then(|index| self.links.get_mut(index));
        match (what, link) {
            (What::Bytes(bytes) | What::Datagram(_, bytes), Some(link)) => {
                link.heard = at;
                link.attached.heard(bytes.len());
                // The port is open: the wire has not hung up.
                let _ = deployment.receive(link.port, &bytes, at);
                if let Ok(status) = deployment.port(link.port) {
                    let was = link.attached.robot();
                    link.attached.note(&status, deployment.server_time(at), self.level);
                    if link.attached.robot() != was {
                        self.join(index.unwrap_or_default());
                    }
                }
            }
            (What::Connection(stream, from), _) => {
                let Some((door, _)) = self.doors.iter().find(|(_, it)| it.source() == source)
                else {
                    return;
                };
                let name = format!("{} from {from}", door.address);
                let stands = door.stands;
                let added = tcp::wire(stream, name.clone()).and_then(|wire| {
                    let attached = Attached::connected(name, wire, stands);
                    self.make_room(deployment);
                    self.add(attached, None, deployment, at)
                });
                if let Err(error) = added {
                    log::warn!("{error}");
                }
            }
            (What::Failed(error), Some(link)) => link.attached.failed(&error),
            (What::Failed(error), None) => log::warn!("{error}"),
            // From a link that was closed meanwhile.
            (What::Bytes(_) | What::Datagram(..), None) => {}
        }
    }

    /// The link of a datagram's sender. A new one gets a link and a port.
    fn peer(
        &mut self,
        source: SourceId,
        from: SocketAddr,
        deployment: &mut Deployment,
        at: Instant,
    ) -> Option<usize> {
        let known = self
            .links
            .iter()
            .position(|link| link.peer == Some((source, from)) && link.attached.is_open());
        if known.is_some() {
            return known;
        }
        let (door, _) = self.doors.iter().find(|(_, listening)| listening.source() == source)?;
        let Socket::Udp(socket) = &door.socket else { return None };
        let name = format!("{} from {from}", door.address);
        let attached = Attached::new(name, Box::new(socket.peer(from)), door.stands);
        self.make_room(deployment);
        // It has no reader of its own, so no thread is started.
        self.add(attached, Some((source, from)), deployment, at).ok()?;
        self.links.len().checked_sub(1)
    }

    /// Closes the stranger at a socket that was silent for longest, if there are too many peers.
    fn make_room(&mut self, deployment: &mut Deployment) {
        if self.links.iter().filter(|link| link.attached.is_of_robot()).count() < MAX_PEERS {
            return;
        }
        let strangers = self
            .links
            .iter()
            .enumerate()
            .filter(|(_, link)| link.attached.is_of_robot() && link.attached.robot().is_none());
        if let Some((index, _)) = strangers.min_by_key(|(_, link)| link.heard) {
            let stranger = self.links.swap_remove(index);
            let _ = deployment.close_port(stranger.port);
        }
    }

    /// Lets a link take over the counters of earlier links of its robot.
    fn join(&mut self, index: usize) {
        let Some(robot) = self.links[index].attached.robot() else { return };
        let is_earlier = |link: &Link| {
            link.attached.robot() == Some(robot)
                && link.attached.is_of_robot()
                && !link.attached.is_open()
        };
        let (earlier, mut others): (Vec<_>, Vec<_>) =
            std::mem::take(&mut self.links).into_iter().partition(is_earlier);
        let here = others.iter_mut().rev().find(|link| link.attached.robot() == Some(robot));
        if let Some(here) = here.filter(|link| link.attached.is_of_robot()) {
            earlier.iter().for_each(|link| here.attached.follows(&link.attached));
            self.links = others;
        } else {
            self.links = others.into_iter().chain(earlier).collect();
        }
    }

    /// Closes the ports of wires that have hung up and of peers that are silent, and opens a port for
    /// each wire that has come back.
    pub(super) fn follow_hang_ups(&mut self, deployment: &mut Deployment, now: Instant) {
        for link in &mut self.links {
            let attached = &mut link.attached;
            let patience = if attached.robot().is_some() { ROBOT_SILENT } else { STRANGER_SILENT };
            if attached.is_of_robot() && now.since(link.heard) > patience {
                attached.hang_up();
            }
            if attached.is_open() {
                continue;
            }
            if let Ok(status) = deployment.port(link.port) {
                attached.end_link(&status);
                // The port is open: it has a status.
                let _ = deployment.close_port(link.port);
            }
            if attached.reopen(now) {
                match attached.listen(&mut self.intake) {
                    Ok(()) => link.port = deployment.open_port(self.policy),
                    Err(error) => attached.failed(&error),
                }
            }
        }
        // A stranger who has left leaves nothing to report.
        self.links.retain(|Link { attached, .. }| {
            attached.is_open() || !attached.is_of_robot() || attached.robot().is_some()
        });
    }

    /// Writes a frame to the link of a port.
    pub(super) fn write(&mut self, port: PortId, frame: &[u8]) {
        if let Some(link) = self.links.iter_mut().find(|link| link.port == port) {
            link.attached.write(frame);
        }
    }
}
