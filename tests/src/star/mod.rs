//! Robots around one server in virtual time, over wires with arbitrary faults. The complete state
//! is checked after every event.

mod checks;
mod way;

use std::collections::{BTreeMap, BTreeSet};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_agent::{Config, Memory, Robot, Seal, Statistics};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, Direction, Key, MAX_FRAME},
    link::{Counters, Terms},
    tile::{Cell, Epoch, TileId},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};
use ubimap_sim_host::{
    camera::{Observation, Sighting},
    mapping::{CureRecord, Cured, Mask, RobotLayer, SeenTile},
    run::heap::Heap,
    server::{Command, CommandError, Policy, Server},
};

pub use way::Way;

use crate::disk::{Disk, Held};

/// Maximum number of rounds of input and output at one point in time; more of them mean that time
/// does not advance.
const MAX_ROUNDS: u32 = 2_000;

/// A robot, across its reboots.
#[derive(Debug)]
pub struct Member<'b> {
    /// The robot's id.
    pub id: RobotId,
    /// The robot's port at the server.
    pub port: usize,
    /// The direction to the server.
    pub up: Way,
    /// The direction to the robot.
    pub down: Way,
    robot: Option<Robot<'b>>,
    /// The last time at which the robot booted or its clock jumped, and what its clock showed then.
    booted: (Instant, u64),
    /// By how much its clock runs fast, in parts per million.
    drift_ppm: i64,
    bytes_at_boot: u64,
    /// Its boot counter.
    boots: u32,
    last: (Statistics, Counters),
    /// The versions of the robot's own tiles, if the server stores tiles on disk.
    own: Held,
}

impl<'b> Member<'b> {
    /// A robot that has not booted yet.
    pub fn new(id: RobotId, port: usize) -> Self {
        Self {
            id,
            port,
            up: Way::new(Direction::ToServer),
            down: Way::new(Direction::ToRobot),
            robot: None,
            booted: (Instant(0), 0),
            drift_ppm: 0,
            bytes_at_boot: 0,
            boots: 0,
            last: Default::default(),
            own: Held::new(),
        }
    }

    /// The robot itself, once booted.
    pub fn robot(&self) -> Option<&Robot<'b>> {
        self.robot.as_ref()
    }

    fn local(&self, now: Instant) -> Instant {
        let elapsed = now.since(self.booted.0).micros() as i64;
        Instant((elapsed + elapsed * self.drift_ppm / 1_000_000) as u64 + self.booted.1)
    }

    /// The first moment at which its clock shows `local` or more.
    fn global(&self, local: Instant) -> Instant {
        let shown = local.0.saturating_sub(self.booted.1) as i64;
        let guess = shown - shown * self.drift_ppm / (1_000_000 + self.drift_ppm);
        let mut moment = self.booted.0 + Duration(guess.saturating_sub(2).max(0) as u64);
        while self.local(moment) < local {
            moment = moment + Duration(1);
        }
        moment
    }
}

/// The key of a member.
fn key_of(member: usize) -> Key {
    Key::new([member as u8 + 1; 16])
}

/// What a restarted server finds on its disk, if it has one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Finds {
    /// What was there when it was killed.
    Disk,
    /// An earlier copy.
    Backup,
    /// As `Disk`, and the record of a cure of this member that has just begun.
    Cure(usize),
}

/// The robots and their server.
#[derive(Debug)]
pub struct Star<'b> {
    server: Server,
    /// The server's disk, if it stores the robots' tiles.
    disk: Option<Disk>,
    terms: Terms,
    ports: usize,
    /// Whether the ports are keyed, and each robot has a key.
    is_sealed: bool,
    /// When the server started, and what its clock showed.
    started: (Instant, u64),
    /// The epochs of the server's earlier lives, and whether this life repeats one of them: then robots
    /// may believe for a while that it holds what it does not.
    used_epochs: BTreeSet<u32>,
    repeats_epoch: bool,
    /// The robots with a cure in progress, and whether any robot was cured in this life of the
    /// server.
    curing: BTreeSet<RobotId>,
    has_cured: bool,
    /// Whether a server has found a backup on its disk.
    has_reverted: bool,
    /// The cells that cameras have seen free in this life of the server.
    seen_free: BTreeSet<(i32, i32)>,
    /// The robots.
    pub members: Vec<Member<'b>>,
    now: Instant,
    frame: Vec<u8>,
    rng: ChaCha8Rng,
    server_changed: bool,
    checked: Checked,
    /// See [`Star::take_longest_queues`].
    longest_queues: [usize; 2],
}

/// The state at the last check.
#[derive(Debug, Default)]
struct Checked {
    layers: BTreeMap<(RobotId, TileId), SeenTile>,
    /// The cells where anything that robots have drawn has ever been put, since it was found that they were off.
    put: BTreeMap<TileId, Mask>,
    first_epochs: BTreeMap<RobotId, Epoch>,
    ports: BTreeMap<usize, Counters>,
}

impl<'b> Star<'b> {
    /// A server without robots; it has a disk if `terms` enable storing. The seed determines
    /// garbage, clocks and the disk.
    pub fn new(terms: Terms, ports: usize, seed: u64) -> Self {
        Self {
            server: Server::new(terms, ports),
            disk: terms.stores.then(Disk::default),
            terms,
            ports,
            is_sealed: false,
            started: (Instant(0), 0),
            used_epochs: BTreeSet::new(),
            repeats_epoch: false,
            curing: BTreeSet::new(),
            has_cured: false,
            has_reverted: false,
            seen_free: BTreeSet::new(),
            members: Vec::new(),
            now: Instant(0),
            frame: vec![0; MAX_FRAME],
            rng: ChaCha8Rng::seed_from_u64(seed),
            server_changed: false,
            checked: Checked::default(),
            longest_queues: [0; 2],
        }
    }

    /// Makes the ports keyed and gives every robot a key, before anything has happened. Of two robots
    /// with one number the server knows the first one's key.
    pub fn seal(&mut self) {
        self.is_sealed = true;
        self.start_server();
    }

    fn start_server(&mut self) {
        self.server = Server::new(self.terms, 0);
        let policy = if self.is_sealed { Policy::Keyed } else { Policy::Open };
        for _ in 0..self.ports {
            self.server.open_port(policy);
        }
        if self.is_sealed {
            self.server.salt_from(self.rng.random());
            for (index, member) in self.members.iter().enumerate().rev() {
                self.server.set_key(member.id, key_of(index));
            }
        }
    }

    /// The simulated time.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// The server.
    pub fn server(&self) -> &Server {
        &self.server
    }

    /// Whether the server has the epoch of an earlier life.
    pub fn repeats_epoch(&self) -> bool {
        self.repeats_epoch
    }

    /// Whether a robot was cured in this life of the server: then it asks robots for tiles that they have
    /// sent already.
    pub fn has_cured(&self) -> bool {
        self.has_cured
    }

    /// Sends a command of the server to a robot.
    ///
    /// # Errors
    /// [`CommandError`].
    pub fn command(&mut self, member: usize, command: Command) -> Result<(), CommandError> {
        let done = self.server.command(self.members[member].id, command);
        self.drain();
        done
    }

    /// Makes a robot's clock run fast or slow from now on, after a jump forward.
    pub fn set_clock(&mut self, member: usize, drift_ppm: i64, jump: Duration) {
        let member = &mut self.members[member];
        member.booted = (self.now, member.local(self.now).0 + jump.0);
        member.drift_ppm = drift_ppm;
    }

    /// Boots a robot, for the first time or again, with fresh memory.
    pub fn boot(&mut self, member: usize, config: Config, life: &'b mut Memory<Heap>) {
        let start = self.rng.random_range(0..600_000_000);
        let key = key_of(member);
        let member = &mut self.members[member];
        member.boots += 1;
        let seal = self.is_sealed.then_some(Seal { key, boot: member.boots });
        let config = Config { seal, ..config };
        member.robot = Some(Robot::new(config, life).expect("the configuration is good"));
        member.booted = (self.now, start);
        member.last = Default::default();
        member.own.clear();
        member.bytes_at_boot = member.up.bytes();
    }

    /// Kills the server and restarts it: from its disk, with its previous clock, or with an empty
    /// map and another clock. If `repeats_epochs`, its epoch is drawn from a small set, so that two
    /// lives without a disk may share one. With a disk it differs from that of the previous life;
    /// once a backup was found, from those of all earlier lives.
    pub fn restart_server(&mut self, frame: u16, finds: Finds, repeats_epochs: bool) {
        self.draw_epoch(finds, repeats_epochs);
        self.terms.frame = frame;
        let begun = self.cure_record(finds);
        self.start_server();
        self.server.number_sessions_from(self.rng.random());
        self.curing.clear();
        self.has_cured = false;
        self.seen_free.clear();
        let clock = match &mut self.disk {
            Some(disk) => {
                disk.survive(&mut self.rng);
                if finds == Finds::Backup {
                    disk.revert();
                }
                if let Some(record) = begun {
                    disk.write_cure(record);
                }
                disk.restore(&mut self.server);
                disk.check_server(&self.server);
                self.curing.extend(disk.curing());
                self.has_cured = !self.curing.is_empty();
                self.server_now().0 + self.rng.random_range(0..5_000_000)
            }
            None => self.rng.random_range(0..600_000_000),
        };
        self.started = (self.now, clock);
        self.checked = Checked::default();
        self.server_changed = true;
    }

    fn draw_epoch(&mut self, finds: Finds, repeats_epochs: bool) {
        let last = self.terms.server_epoch;
        self.used_epochs.insert(last);
        self.terms.server_epoch = self.rng.random_range(1..=4);
        self.has_reverted |= finds == Finds::Backup;
        if self.has_reverted || !repeats_epochs {
            self.terms.server_epoch = 10 + self.used_epochs.len() as u32;
        } else if self.disk.is_some() && self.terms.server_epoch == last {
            self.terms.server_epoch += 1;
        }
        self.repeats_epoch = self.used_epochs.contains(&self.terms.server_epoch);
    }

    /// The record of a cure that has begun.
    fn cure_record(&self, finds: Finds) -> Option<CureRecord> {
        let Finds::Cure(member) = finds else { return None };
        let robot = self.members[member].id;
        let first_epoch = self.server.layer(robot).map_or(Epoch(0), RobotLayer::first_epoch);
        Some(CureRecord { robot, cured: Cured::default(), first_epoch, is_over: false })
    }

    /// Copies the server's disk.
    pub fn back_up(&mut self) {
        self.disk.iter_mut().for_each(Disk::back_up);
    }

    /// Switches a robot off.
    pub fn switch_off(&mut self, member: usize) {
        let member = &mut self.members[member];
        member.robot = None;
        member.up.lose_all();
        member.down.lose_all();
    }

    /// Reports free ground that a camera sees, out of every robot's reach: cells of the grid.
    pub fn look(&mut self, cells: impl Iterator<Item = (i32, i32)>) {
        let cells: Vec<_> = cells.map(|cell| (cell, Cell::Free)).collect();
        self.seen_free.extend(cells.iter().map(|(cell, _)| cell));
        let captured = self.server_now();
        let camera = self.members.len();
        let seen = Observation { camera, captured, cells, ..Observation::default() };
        self.server.observe(&seen);
        self.server_changed = true;
        self.drain();
    }

    /// Makes all writes of the server's disk fail for some time.
    pub fn fail_store(&mut self, length: Duration) {
        let until = self.server_now() + length;
        if let Some(disk) = &mut self.disk {
            disk.fail_until(until);
        }
    }

    /// The maximum number of messages that have waited for one robot, and of writes that the disk
    /// has had in progress, since the last call.
    pub fn take_longest_queues(&mut self) -> [usize; 2] {
        std::mem::take(&mut self.longest_queues)
    }

    /// The server's disk.
    pub fn disk_mut(&mut self) -> Option<&mut Disk> {
        self.disk.as_mut()
    }

    /// Moves a robot to another port; frames in flight are lost.
    pub fn move_to_port(&mut self, member: usize, port: usize) {
        let member = &mut self.members[member];
        member.port = port;
        member.up.lose_all();
        member.down.lose_all();
    }

    /// Sends random bytes to the server or to a robot.
    pub fn garbage(&mut self, member: usize, direction: Direction) {
        let len = self.rng.random_range(1..400);
        let bytes: Vec<u8> =
            (0..len).map(|_| self.rng.random::<u8>() & self.rng.random::<u8>()).collect();
        self.inject(member, direction, &bytes);
    }

    /// Delivers an earlier frame again, or an earlier frame of a handshake.
    pub fn replay(&mut self, member: usize, direction: Direction, handshakes_only: bool) {
        let way = match direction {
            Direction::ToServer => &self.members[member].up,
            Direction::ToRobot => &self.members[member].down,
        };
        let remembered = way.remembered(handshakes_only);
        if remembered.is_empty() {
            return;
        }
        let frame = remembered[self.rng.random_range(0..remembered.len())].to_vec();
        self.inject(member, direction, &frame);
    }

    fn inject(&mut self, member: usize, direction: Direction, bytes: &[u8]) {
        let server_now = self.server_now();
        let member = &mut self.members[member];
        match direction {
            Direction::ToServer => {
                self.server.receive(member.port, bytes, server_now).expect("there is such a port");
                self.server_changed = true;
            }
            Direction::ToRobot => {
                let local = member.local(self.now);
                if let Some(robot) = &mut member.robot {
                    robot.receive(bytes, local);
                }
            }
        }
        self.drain();
        self.check();
    }

    /// Gives a robot an odometry reading and a scan.
    pub fn scan(&mut self, member: usize, pose: Option<Pose>, readings: &[u16]) {
        let member = &mut self.members[member];
        let local = member.local(self.now);
        let Some(robot) = &mut member.robot else { return };
        if let Some(pose) = pose {
            robot.odometry(local, pose, local);
        }
        // The robot itself counts scans for which the queue was full.
        let _ = robot.scan(local, readings, local);
        self.drain();
        self.check_robots();
    }

    /// Reports a camera sighting of a robot.
    pub fn fix(&mut self, member: usize, pose: Pose) {
        let robots = vec![Sighting::usual(self.members[member].id, pose)];
        let captured = self.server_now();
        self.server.observe(&Observation {
            camera: member,
            captured,
            robots,
            ..Observation::default()
        });
        self.drain();
    }

    /// Processes everything due up to a time.
    pub fn run_until(&mut self, until: Instant) {
        let mut rounds = 0;
        while let Some(next) = self.next_due().filter(|&next| next <= until) {
            rounds = if next > self.now { 0 } else { rounds + 1 };
            assert!(rounds < MAX_ROUNDS, "time stands still: {}", self.who_is_due());
            self.now = self.now.max(next);
            self.deliver();
            let server_now = self.server_now();
            if let Some(disk) = &mut self.disk {
                disk.work(&mut self.server, server_now, &mut self.rng);
                self.curing = disk.curing().collect();
            }
            self.watch_queues();
            self.drain();
            self.check();
        }
        self.now = self.now.max(until);
    }

    /// The time by the server's clock.
    pub fn server_now(&self) -> Instant {
        Instant(self.now.since(self.started.0).micros() + self.started.1)
    }

    fn next_due(&self) -> Option<Instant> {
        let server_now = self.server_now();
        let robots = self.members.iter().flat_map(|member| {
            let robot = member.robot.as_ref();
            [
                member.up.next_delivery(),
                member.down.next_delivery(),
                robot.map(|robot| member.global(robot.poll_timeout())),
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

    /// The next deadlines, for messages.
    fn who_is_due(&self) -> String {
        let server_now = self.server_now();
        let robots = self.members.iter().map(|member| {
            let due = member.robot.as_ref().map(|robot| member.global(robot.poll_timeout()));
            format!("robot {} at {due:?}", member.id.0)
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
        for member in &mut self.members {
            while let Some(bytes) = member.up.poll(self.now) {
                self.server.receive(member.port, &bytes, server_now).expect("there is such a port");
                self.server_changed = true;
            }
            let local = member.local(self.now);
            while let Some(bytes) = member.down.poll(self.now) {
                if let Some(robot) = &mut member.robot {
                    robot.receive(&bytes, local);
                }
            }
            if let Some(robot) = &mut member.robot {
                robot.timeout(local);
            }
        }
        self.server.timeout(server_now);
    }

    fn drain(&mut self) {
        let server_now = self.server_now();
        for member in &mut self.members {
            let local = member.local(self.now);
            let Some(robot) = &mut member.robot else { continue };
            let out = &mut self.frame[..DEFAULT_FRAME];
            let mut frames = 0;
            while let Some(len) = robot.poll_transmit(local, out) {
                member.up.send(self.now, &out[..len]);
                frames += 1;
                assert!(frames < MAX_ROUNDS, "robot {} never stops sending", member.id.0);
            }
        }
        for port in 0..self.ports {
            let mut frames = 0;
            while let Some(len) = self.server.poll_transmit(port, server_now, &mut self.frame) {
                if let Some(member) = self.members.iter_mut().find(|member| member.port == port) {
                    member.down.send(self.now, &self.frame[..len]);
                }
                frames += 1;
                assert!(frames < MAX_ROUNDS, "port {port} never stops sending");
            }
        }
    }
}
