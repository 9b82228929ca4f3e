//! Robots around one server, under virtual time, over wires at which anything may be done to
//! them. After every moment at which something happened the state of all is checked.

use std::{
    collections::{BTreeMap, BTreeSet},
    iter, mem,
};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{Agent, Config, Statistics};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, Direction, MAX_FRAME, SessionId, cobs, open},
    link::{Counters, Terms},
    tile::{Layer, Stamp, TILE_SIDE, Tile, TileId, tile_hash},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    channel::fault::{FaultWire, Faults},
    mapping::{SeenTile, clear, fuse},
    run::fleet::AgentMemory,
    server::{Command, CommandError, Server},
};

use crate::disk::{Disk, Held};

/// Rounds of input and output at one moment, after which time is taken to stand still for good.
const MOST_ROUNDS: u32 = 2_000;
/// Frames that a way remembers, so that they can be replayed: the first, and the last.
const REMEMBERED: usize = 40;

/// One direction of a robot's channel.
#[derive(Debug)]
pub struct Way {
    /// The last one takes what is sent; what is still on its way in the others arrives.
    wires: Vec<FaultWire>,
    cut_until: Instant,
    remembered: Vec<Vec<u8>>,
    sent: usize,
    /// The frames of sessions so far, if a frame that comes again is dropped.
    once: Option<BTreeSet<Vec<u8>>>,
    direction: Direction,
    /// Bytes that were given to it, whatever became of them.
    bytes: u64,
}

impl Way {
    fn new(direction: Direction) -> Self {
        Self {
            wires: vec![FaultWire::new(Faults::default(), 0)],
            cut_until: Instant(0),
            remembered: Vec::new(),
            sent: 0,
            once: None,
            direction,
            bytes: 0,
        }
    }

    /// From now on it is as bad as that.
    pub fn weather(&mut self, faults: Faults, seed: u64) {
        self.wires.retain(|wire| wire.next_delivery().is_some());
        self.wires.push(FaultWire::new(faults, seed));
    }

    /// What is sent before then is lost.
    pub fn cut(&mut self, until: Instant) {
        self.cut_until = self.cut_until.max(until);
    }

    /// From now on a frame of a session that is sent again is lost.
    pub fn drop_repeats(&mut self) {
        self.once = Some(BTreeSet::new());
    }

    /// Bytes that were given to it so far, whatever became of them.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    fn send(&mut self, now: Instant, frame: &[u8]) {
        self.bytes += frame.len() as u64;
        if self.sent < 2 * REMEMBERED {
            self.remembered.push(frame.to_vec());
        } else {
            self.remembered[REMEMBERED + self.sent % REMEMBERED] = frame.to_vec();
        }
        self.sent += 1;
        let repeated = self.once.as_mut().is_some_and(|seen| {
            !is_handshake(frame, self.direction) && !seen.insert(frame.to_vec())
        });
        if now < self.cut_until || repeated {
            return;
        }
        if let Some(wire) = self.wires.last_mut() {
            wire.send(now, frame);
        }
    }

    fn poll(&mut self, now: Instant) -> Option<Vec<u8>> {
        self.wires.iter_mut().find_map(|wire| wire.poll(now))
    }

    fn next_delivery(&self) -> Option<Instant> {
        self.wires.iter().filter_map(FaultWire::next_delivery).min()
    }

    fn lose_all(&mut self) {
        for wire in &mut self.wires {
            while wire.poll(Instant(u64::MAX)).is_some() {}
        }
    }
}

fn is_handshake(frame: &[u8], direction: Direction) -> bool {
    let mut decoder = cobs::Decoder::<MAX_FRAME>::default();
    let contents = decoder.next(&mut &*frame);
    matches!(contents, Some(Ok(frame)) if open(SessionId::NONE, direction, frame).is_some())
}

/// One robot, in whichever of its lives.
#[derive(Debug)]
pub struct Robot<'b> {
    /// Its number.
    pub id: RobotId,
    /// Where it is plugged in at the server.
    pub port: usize,
    /// To the server.
    pub up: Way,
    /// To the robot.
    pub down: Way,
    agent: Option<Agent<'b>>,
    /// When it booted, and what its clock showed.
    booted: (Instant, u64),
    bytes_at_boot: u64,
    last: (Statistics, Counters),
    /// The tiles of its own that it held, if the server keeps any on disk.
    own: Held,
}

impl<'b> Robot<'b> {
    /// A robot that is not there yet.
    pub fn new(id: RobotId, port: usize) -> Self {
        Self {
            id,
            port,
            up: Way::new(Direction::ToServer),
            down: Way::new(Direction::ToRobot),
            agent: None,
            booted: (Instant(0), 0),
            bytes_at_boot: 0,
            last: Default::default(),
            own: Held::new(),
        }
    }

    /// Its agent, once it has booted.
    pub fn agent(&self) -> Option<&Agent<'b>> {
        self.agent.as_ref()
    }

    fn local(&self, now: Instant) -> Instant {
        Instant(now.since(self.booted.0).micros() + self.booted.1)
    }

    fn global(&self, local: Instant) -> Instant {
        self.booted.0 + Duration(local.0.saturating_sub(self.booted.1))
    }
}

/// The robots and their server.
#[derive(Debug)]
pub struct Star<'b> {
    server: Server,
    /// Where it keeps what robots tell, if it does.
    disk: Option<Disk>,
    terms: Terms,
    ports: usize,
    /// When the server started, and what its clock showed.
    started: (Instant, u64),
    /// The robots.
    pub robots: Vec<Robot<'b>>,
    now: Instant,
    frame: Vec<u8>,
    rng: ChaCha8Rng,
    server_changed: bool,
    checked: Checked,
}

/// What the last check saw.
#[derive(Debug, Default)]
struct Checked {
    layers: BTreeMap<(RobotId, TileId), SeenTile>,
    ports: BTreeMap<usize, Counters>,
}

impl<'b> Star<'b> {
    /// A server without robots, with a disk if the terms say that it stores. The seed is for garbage,
    /// clocks and the disk.
    pub fn new(terms: Terms, ports: usize, seed: u64) -> Self {
        Self {
            server: Server::new(terms, ports),
            disk: terms.stores.then(Disk::default),
            terms,
            ports,
            started: (Instant(0), 0),
            robots: Vec::new(),
            now: Instant(0),
            frame: vec![0; MAX_FRAME],
            rng: ChaCha8Rng::seed_from_u64(seed),
            server_changed: false,
            checked: Checked::default(),
        }
    }

    /// The time by which everything here goes.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// The server.
    pub fn server(&self) -> &Server {
        &self.server
    }

    /// The server commands a robot.
    ///
    /// # Errors
    /// Every [`CommandError`].
    pub fn command(&mut self, robot: usize, command: Command) -> Result<(), CommandError> {
        let done = self.server.command(self.robots[robot].id, command);
        self.drain();
        done
    }

    /// A robot boots, for the first time or anew, with fresh memory.
    pub fn boot(&mut self, robot: usize, config: Config, life: &'b mut AgentMemory) {
        let start = self.rng.random_range(0..600_000_000);
        let robot = &mut self.robots[robot];
        let agent = Agent::new(config, life.lend());
        robot.agent = Some(agent.expect("the configuration is good"));
        robot.booted = (self.now, start);
        robot.last = Default::default();
        robot.own.clear();
        robot.bytes_at_boot = robot.up.bytes;
    }

    /// The server is killed and starts anew, with a new epoch: from its disk, and then with the
    /// clock of its life before, or with an empty map and another clock.
    pub fn restart_server(&mut self) {
        self.terms.server_epoch += 1;
        self.server = Server::new(self.terms, self.ports);
        let clock = match &mut self.disk {
            Some(disk) => {
                disk.survive(&mut self.rng);
                disk.restore(&mut self.server);
                disk.check_server(&self.server);
                self.server_now().0 + self.rng.random_range(0..5_000_000)
            }
            None => self.rng.random_range(0..600_000_000),
        };
        self.started = (self.now, clock);
        self.checked = Checked::default();
        self.server_changed = true;
    }

    /// A robot is plugged in elsewhere; what is under way is lost.
    pub fn move_to_port(&mut self, robot: usize, port: usize) {
        let robot = &mut self.robots[robot];
        robot.port = port;
        robot.up.lose_all();
        robot.down.lose_all();
    }

    /// Bytes that nobody sent arrive at the server or at a robot.
    pub fn garbage(&mut self, robot: usize, direction: Direction) {
        let len = self.rng.random_range(1..400);
        let bytes: Vec<u8> =
            (0..len).map(|_| self.rng.random::<u8>() & self.rng.random::<u8>()).collect();
        self.inject(robot, direction, &bytes);
    }

    /// An earlier frame arrives once more.
    pub fn replay(&mut self, robot: usize, direction: Direction) {
        let way = match direction {
            Direction::ToServer => &self.robots[robot].up,
            Direction::ToRobot => &self.robots[robot].down,
        };
        if way.remembered.is_empty() {
            return;
        }
        let index = self.rng.random_range(0..way.remembered.len());
        let frame = way.remembered[index].clone();
        self.inject(robot, direction, &frame);
    }

    fn inject(&mut self, robot: usize, direction: Direction, bytes: &[u8]) {
        let server_now = self.server_now();
        let robot = &mut self.robots[robot];
        match direction {
            Direction::ToServer => {
                self.server.receive(robot.port, bytes, server_now).expect("there is such a port");
                self.server_changed = true;
            }
            Direction::ToRobot => {
                let local = robot.local(self.now);
                if let Some(agent) = &mut robot.agent {
                    agent.receive(bytes, local);
                }
            }
        }
        self.drain();
        self.check();
    }

    /// A robot reads its odometry and takes a scan.
    pub fn scan(&mut self, robot: usize, pose: Option<Pose>, readings: &[u16]) {
        let robot = &mut self.robots[robot];
        let local = robot.local(self.now);
        let Some(agent) = &mut robot.agent else { return };
        if let Some(pose) = pose {
            agent.odometry(local, pose, local);
        }
        // Full queues are counted by the agent.
        let _ = agent.scan(local, readings, local);
        self.drain();
    }

    /// The cameras see a robot.
    pub fn fix(&mut self, robot: usize, pose: Pose) {
        let robots = vec![Sighting::usual(self.robots[robot].id, pose)];
        let captured = self.server_now();
        self.server.observe(&Observation {
            camera: robot,
            captured,
            robots,
            ..Observation::default()
        });
        self.drain();
    }

    /// Lets all that is due until then happen.
    pub fn run_until(&mut self, until: Instant) {
        let mut rounds = 0;
        while let Some(next) = self.next_due().filter(|&next| next <= until) {
            rounds = if next > self.now { 0 } else { rounds + 1 };
            assert!(rounds < MOST_ROUNDS, "time stands still: {}", self.who_is_due());
            self.now = self.now.max(next);
            self.deliver();
            let server_now = self.server_now();
            if let Some(disk) = &mut self.disk {
                disk.work(&mut self.server, server_now, &mut self.rng);
            }
            self.drain();
            self.check();
        }
        self.now = self.now.max(until);
    }

    fn server_now(&self) -> Instant {
        Instant(self.now.since(self.started.0).micros() + self.started.1)
    }

    fn next_due(&self) -> Option<Instant> {
        let server_now = self.server_now();
        let robots = self.robots.iter().flat_map(|robot| {
            let agent = robot.agent.as_ref();
            [
                robot.up.next_delivery(),
                robot.down.next_delivery(),
                agent.map(|agent| robot.global(agent.poll_timeout())),
            ]
        });
        let ports = (0..self.ports).map(|port| {
            let due = self.server.poll_timeout(port, server_now)?;
            Some(self.now + due.since(server_now))
        });
        let write = self.disk.as_ref().and_then(Disk::next_due);
        let write = write.map(|due| self.now + due.since(server_now));
        robots.chain(ports).flatten().chain(write).min()
    }

    /// For messages: who wants to come back, and when.
    fn who_is_due(&self) -> String {
        let server_now = self.server_now();
        let robots = self.robots.iter().map(|robot| {
            let due = robot.agent.as_ref().map(|agent| robot.global(agent.poll_timeout()));
            format!("robot {} at {due:?}", robot.id.0)
        });
        let ports = (0..self.ports).map(|port| {
            let due = self.server.poll_timeout(port, server_now);
            format!("port {port} at {due:?}")
        });
        let all: Vec<String> = robots.chain(ports).collect();
        format!("now {:?}, {server_now:?} at the server; {}", self.now, all.join(", "))
    }

    fn deliver(&mut self) {
        let server_now = self.server_now();
        for robot in &mut self.robots {
            while let Some(bytes) = robot.up.poll(self.now) {
                self.server.receive(robot.port, &bytes, server_now).expect("there is such a port");
                self.server_changed = true;
            }
            let local = robot.local(self.now);
            while let Some(bytes) = robot.down.poll(self.now) {
                if let Some(agent) = &mut robot.agent {
                    agent.receive(&bytes, local);
                }
            }
            if let Some(agent) = &mut robot.agent {
                agent.timeout(local);
            }
        }
    }

    fn drain(&mut self) {
        let server_now = self.server_now();
        for robot in &mut self.robots {
            let local = robot.local(self.now);
            let Some(agent) = &mut robot.agent else { continue };
            let out = &mut self.frame[..DEFAULT_FRAME];
            let mut frames = 0;
            while let Some(len) = agent.poll_transmit(local, out) {
                robot.up.send(self.now, &out[..len]);
                frames += 1;
                assert!(frames < MOST_ROUNDS, "robot {} never stops sending", robot.id.0);
            }
        }
        for port in 0..self.ports {
            let mut frames = 0;
            while let Some(len) = self.server.poll_transmit(port, server_now, &mut self.frame) {
                if let Some(robot) = self.robots.iter_mut().find(|robot| robot.port == port) {
                    robot.down.send(self.now, &self.frame[..len]);
                }
                frames += 1;
                assert!(frames < MOST_ROUNDS, "port {port} never stops sending");
            }
        }
    }

    /// Why not all hold the same yet; `None` if they do.
    pub fn behind(&self) -> Option<String> {
        self.robots.iter().find_map(|robot| {
            let agent = robot.agent.as_ref()?;
            let why = self.behind_at(robot, agent)?;
            Some(format!("robot {}: {why}", robot.id.0))
        })
    }

    fn behind_at(&self, robot: &Robot<'b>, agent: &Agent<'b>) -> Option<String> {
        if !agent.is_connected() || self.server.robot_at(robot.port) != Some(robot.id) {
            return Some(format!(
                "no session, port {} has {:?}",
                robot.port,
                self.server.robot_at(robot.port)
            ));
        }
        if self.server.state(robot.id).is_none() {
            // An old hello may have opened the session: then the robot speaks in another one.
            return Some("the server has heard nothing of it in this session".into());
        }
        if !agent.is_idle() {
            let dirty: Vec<_> = agent.own_tiles().tiles().filter(|tile| tile.is_dirty()).collect();
            let dirty: Vec<_> =
                dirty.iter().map(|tile| (tile.id(), tile.publication().is_ready())).collect();
            return Some(format!("it has more to tell: {dirty:?}"));
        }
        if !self.server.is_level(robot.id) {
            return Some("the server has more to tell it".into());
        }
        for tile in agent.own_tiles().tiles() {
            let stamp = Stamp { epoch: tile.epoch(), version: tile.publication().version() };
            let layer = self.server.layer(robot.id);
            let held = layer.zip(tile.id()).and_then(|(layer, id)| layer.held(id, tile.epoch()));
            let hash = tile_hash(tile.publication().sent());
            if held.is_none_or(|(held, cells)| held != stamp || tile_hash(cells) != hash) {
                let held = held.map(|(held, _)| held);
                return Some(format!(
                    "of its {:?} at {stamp:?} the server holds {held:?}",
                    tile.id()
                ));
            }
        }
        let epoch = self.server.epoch();
        for (id, replica) in agent.fused_tiles().tiles(Layer::Fused) {
            let newest = self.server.fused().get(id);
            let same = newest.is_some_and(|(version, cells)| {
                replica.stamp() == Stamp { epoch, version }
                    && tile_hash(replica.tile()) == tile_hash(cells)
            });
            if !same || replica.is_partial() {
                let newest = newest.map(|(version, _)| version);
                return Some(format!(
                    "of the fused {id:?} at {newest:?} it holds {:?}, partial {}",
                    replica.stamp(),
                    replica.is_partial()
                ));
            }
        }
        self.missing_at(agent).map(|id| format!("it lacks the fused {id:?}"))
    }

    /// A fused tile that a robot wants and does not hold.
    fn missing_at(&self, agent: &Agent<'b>) -> Option<TileId> {
        let window = agent.fused_tiles().interest()?;
        let mut wanted = self.server.fused().within(&window);
        wanted.find_map(|(id, ..)| {
            (!agent.fused_tiles().tiles(Layer::Fused).any(|(held, _)| held == id)).then_some(id)
        })
    }

    /// A tile of a robot's own that it holds acknowledged and does not know to be stored.
    pub fn unstored(&self) -> Option<String> {
        self.disk.as_ref()?;
        self.robots.iter().find_map(|robot| {
            let mut tiles = robot.agent.as_ref()?.own_tiles().tiles();
            let tile = tiles.find(|tile| tile.stored() != tile.publication().version())?;
            let (stored, version) = (tile.stored(), tile.publication().version());
            let robot = robot.id.0;
            Some(format!("{:?} of robot {robot}: {stored:?} of {version:?} is stored", tile.id()))
        })
    }

    /// When a robot holds every fused tile that it wants, as new as the server's. `None` before
    /// it wants any.
    pub fn holds_its_window(&self, robot: usize) -> Option<bool> {
        let agent = self.robots[robot].agent.as_ref()?;
        let window = agent.fused_tiles().interest()?;
        let epoch = self.server.epoch();
        let level = self.server.fused().within(&window).all(|(id, version, cells)| {
            let mut held = agent.fused_tiles().tiles(Layer::Fused).filter(|(held, _)| *held == id);
            held.any(|(_, replica)| {
                let newest = replica.stamp() == Stamp { epoch, version };
                newest && !replica.is_partial() && replica.tile() == cells
            })
        });
        Some(level)
    }

    /// Bytes of frames with tiles of robots so far, and frames sent again.
    pub fn effort(&self) -> Vec<(u64, u32)> {
        let agents = self.robots.iter().filter_map(|robot| robot.agent.as_ref());
        agents
            .map(|agent| (agent.statistics().bytes_sent_map, agent.link_counters().retransmissions))
            .collect()
    }

    /// What must hold at any moment.
    fn check(&mut self) {
        self.check_agents();
        if mem::take(&mut self.server_changed) {
            self.check_layers();
            self.check_acknowledged();
            self.check_ports();
        }
    }

    /// Nothing that the server knew of a robot's layer is unknown again, and the fused layer is
    /// what the layers make.
    fn check_layers(&mut self) {
        let seconds = (self.server_now().micros() / 1_000_000) as u32 + 1;
        let mut changed = BTreeSet::new();
        for robot in &self.robots {
            let Some(layer) = self.server.layer(robot.id) else { continue };
            for (id, seen) in layer.tiles() {
                let before = self.checked.layers.entry((robot.id, id));
                let before = before.or_insert(SeenTile::NOTHING);
                if before.tile == seen.tile {
                    assert!(before.seconds == seen.seconds, "a time without a change: {id:?}");
                    continue;
                }
                let newest = seen.seconds.iter().max().copied().unwrap_or(0);
                assert!(newest <= seconds, "{id:?} was seen at {newest} s, it is {seconds} s now");
                let known = |tile: &Tile, y: usize| tile.row(y).known();
                let kept =
                    (0..TILE_SIDE).all(|y| known(&before.tile, y) & !known(&seen.tile, y) == 0);
                assert!(kept, "{:?} of robot {} has forgotten cells", id, robot.id.0);
                *before = seen.clone();
                changed.insert(id);
            }
        }
        changed.into_iter().for_each(|id| self.check_fused(id));
    }

    fn check_fused(&self, id: TileId) {
        let server = &self.server;
        let layers = self
            .robots
            .iter()
            .filter_map(|robot| Some((server.weight(robot.id), server.layer(robot.id)?.seen(id)?)));
        let layers: Vec<_> = layers.collect();
        // The cameras of these runs see robots, and no cells.
        let mut expected = fuse(&SeenTile::NOTHING, &layers, server.map_time());
        clear(&mut expected, &server.under(id));
        let found = self.server.fused().get(id).map(|(_, tile)| tile);
        assert!(found == Some(&expected), "{id:?} is not what the layers make");
    }

    /// Every fused tile is what the layers make, and the layers know what is on disk.
    pub fn check_all(&self) {
        self.disk.iter().for_each(|disk| disk.check_server(&self.server));
        self.server.fused().tiles().for_each(|(id, ..)| self.check_fused(id));
    }

    /// What the robot believes to be acknowledged is.
    fn check_acknowledged(&self) {
        for robot in &self.robots {
            let Some(agent) = &robot.agent else { continue };
            // A welcome of the server's life before may come late.
            if agent.server_epoch() != Some(self.server.epoch()) || !agent.is_connected() {
                continue;
            }
            let Some(layer) = self.server.layer(robot.id) else { continue };
            for tile in agent.own_tiles().tiles().filter(|it| it.publication().is_acknowledged()) {
                let held = tile.id().and_then(|id| layer.held(id, tile.epoch()));
                let version = tile.publication().version();
                assert!(
                    held.is_some_and(|(stamp, _)| stamp.version >= version),
                    "{:?} of robot {} at {version:?} is acknowledged, the server holds {:?}",
                    tile.id(),
                    robot.id.0,
                    held.map(|(stamp, _)| stamp)
                );
            }
        }
    }

    fn check_ports(&mut self) {
        for port in 0..self.ports {
            let now = self.server.link_counters(port);
            let last = self.checked.ports.insert(port, now).unwrap_or_default();
            check_counters(last, now);
            assert_eq!(self.server.unread_messages(port), (0, 0), "at port {port}");
        }
    }

    fn check_agents(&mut self) {
        for robot in &mut self.robots {
            let Some(agent) = &robot.agent else { continue };
            if let Some(disk) = &self.disk {
                disk.check_robot(robot.id, agent.own_tiles(), &mut robot.own);
            }
            let (now, link) = (agent.statistics(), agent.link_counters());
            let (before, link_before) = mem::replace(&mut robot.last, (now, link));
            check_counters(link_before, link);
            assert_eq!((now.unknown_messages, now.malformed_messages), (0, 0));
            assert_eq!(now.bytes_sent, robot.up.bytes - robot.bytes_at_boot);
            assert!(now.bytes_sent_map <= now.bytes_sent && now.bytes_sent >= before.bytes_sent);
            let settled = now.mapped + now.gated + now.shaken + now.unsure + now.expired;
            assert!((settled..=settled + 4).contains(&now.scans), "{now:?}");
            assert_eq!(now.pixels.seen, now.pixels.kept + now.pixels.omitted + now.pixels.invalid);
        }
    }
}

fn check_counters(before: Counters, now: Counters) {
    let fields = |it: Counters| {
        [it.sent, it.retransmissions, it.received, it.duplicates, it.bad, it.refused]
    };
    let grown = iter::zip(fields(before), fields(now)).all(|(before, now)| before <= now);
    let sound = now.retransmissions <= now.sent && now.duplicates <= now.received;
    assert!(grown && sound, "{before:?} became {now:?}");
    assert_eq!(now.refused, 0, "a good frame is never refused");
}
