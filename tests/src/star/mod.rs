//! Robots around one server, under virtual time, over wires at which anything may be done to
//! them. After every moment at which something happened the state of all is checked.

mod checks;
mod way;

use std::collections::BTreeMap;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{Agent, Config, Statistics};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, Direction, MAX_FRAME},
    link::{Counters, Terms},
    tile::TileId,
    time::{Duration, Instant},
    units::{Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    mapping::SeenTile,
    run::fleet::AgentMemory,
    server::{Command, CommandError, Server},
};

pub use way::Way;

use crate::disk::{Disk, Held};

/// Rounds of input and output at one moment, after which time is taken to stand still for good.
const MOST_ROUNDS: u32 = 2_000;

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
        robot.bytes_at_boot = robot.up.bytes();
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
        self.server.timeout(server_now);
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
}
