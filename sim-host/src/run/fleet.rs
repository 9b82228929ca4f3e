//! Robots and a deployment, joined by channels under virtual time.
//!
//! Nothing here waits: the clock jumps from event to event, each robot and the deployment come back
//! when they asked to, and the same seed gives the same bytes.

use ubimap_agent::{
    Agent, Config, ConfigError, Memory, Pilot,
    drive::{self, DriveCommand, Stops},
    map::{OwnTile, RowSighting, scratch_words},
    sense::Beam,
    share::FusedTile,
};
use ubimap_protocol::{
    frame::{DEFAULT_FRAME, Direction, MAX_FRAME},
    tile::{TILE_SIDE, TileId},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::keeper::Keeper;
use crate::{
    camera::{Frame, Observation},
    channel::fault::{FaultWire, Faults},
    deployment::{self, Deployment, PortId},
    report::{Comparison, Published},
    server::Server,
    store::StoreError,
};

/// Tiles of its own that a robot keeps, unless more are asked for.
pub const OWN_TILES: usize = 32;
/// Fused tiles that a robot keeps.
pub const FUSED_TILES: usize = 64;
/// Scans that can wait for their poses on a robot.
const WAITING_SCANS: usize = 4;

/// Something that happens at a moment of a run.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A robot, by its place in the fleet, takes a scan.
    Scan {
        /// Which robot.
        robot: usize,
        /// Readings in millimetres, 0 where nothing came back.
        readings: Vec<u16>,
    },
    /// A robot reads its odometry.
    Odometry {
        /// Which robot.
        robot: usize,
        /// `base_link` in `odom`.
        pose: Pose,
    },
    /// A robot that drives itself says what its wheels shall do.
    Drive {
        /// Which robot.
        robot: usize,
    },
    /// A frame of a camera has arrived.
    Frame(Frame),
    /// A frame of a camera has been looked at.
    Observation(Observation),
}

/// Where the events come from: a log, or a simulated room.
pub trait Stage {
    /// When the next event happens; `None` if there will be no more.
    fn next_event(&self) -> Option<Instant>;

    /// An event that has happened by `now`, oldest first.
    fn poll(&mut self, now: Instant) -> Option<Event>;

    /// A robot's wheels shall do this from now on.
    fn drive(&mut self, _robot: usize, _command: DriveCommand) {}
}

/// The memory of one agent, sized like a robot's.
#[derive(Debug)]
pub struct AgentMemory {
    beams: Vec<Beam>,
    waiting: Vec<u16>,
    scratch: Vec<RowSighting>,
    own: Vec<OwnTile>,
    fused: Vec<FusedTile>,
}

impl AgentMemory {
    /// Memory for scans of so many readings, and for so many tiles of its own and fused ones.
    pub fn new(config: &Config, readings: usize, own_tiles: usize, fused_tiles: usize) -> Self {
        Self {
            beams: vec![Beam::default(); readings],
            waiting: vec![0; readings * WAITING_SCANS],
            scratch: vec![
                RowSighting::default();
                scratch_words(config.max_range, config.resolution)
            ],
            own: vec![OwnTile::FREE; own_tiles],
            fused: vec![FusedTile::FREE; fused_tiles],
        }
    }

    /// Lends it to an agent.
    pub fn lend(&mut self) -> Memory<'_> {
        Memory {
            beams: &mut self.beams,
            waiting: &mut self.waiting,
            scratch: &mut self.scratch,
            own: &mut self.own,
            fused: &mut self.fused,
        }
    }
}

/// A robot's clock: it starts somewhere, and runs a little fast or slow.
#[derive(Clone, Copy, Debug)]
struct RobotClock {
    start: u64,
    ppm: i64,
}

impl RobotClock {
    /// Clocks of different robots differ by minutes and up to 40 ppm.
    fn of(robot: RobotId, seed: u64) -> Self {
        // SplitMix64's mixing step: any two clocks differ.
        let mixed = (seed ^ u64::from(robot.0) << 32).wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (mixed ^ mixed >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = mixed ^ mixed >> 27;
        Self { start: mixed % 600_000_000, ppm: (mixed >> 32) as i64 % 41 }
    }

    fn local(self, server: Instant) -> Instant {
        let drift = server.0 as i64 * self.ppm / 1_000_000;
        Instant(self.start.wrapping_add(server.0).wrapping_add(drift as u64))
    }

    /// The first moment of the server's clock at which this one shows `local`.
    fn server(self, local: Instant) -> Instant {
        if local.0 == u64::MAX {
            return local;
        }
        let elapsed = local.0.saturating_sub(self.start);
        let scaled = i128::from(elapsed) * 1_000_000 / i128::from(1_000_000 + self.ppm);
        let mut server = Instant((scaled as u64).saturating_sub(2));
        while self.local(server) < local {
            server.0 += 1;
        }
        server
    }
}

/// One robot with its channel.
pub struct Robot<'b> {
    id: RobotId,
    /// Its port of the deployment.
    port: PortId,
    clock: RobotClock,
    agent: Agent<'b>,
    /// What drives it, if it does not drive a route.
    pilot: Option<Box<Pilot>>,
    up: FaultWire,
    down: FaultWire,
    path: Vec<(Instant, Pose)>,
    /// Readings of a scan.
    beams: usize,
    published: Published,
    /// Its map traffic when what it had published was last taken note of.
    bytes_noted: u64,
}

impl Robot<'_> {
    /// Takes note of what it has published by now.
    fn take_note(&mut self) {
        let bytes_sent_map = self.agent.statistics().bytes_sent_map;
        if bytes_sent_map > self.bytes_noted {
            self.bytes_noted = bytes_sent_map;
            let tiles = self.agent.own_tiles().tiles();
            self.published
                .update(tiles.filter_map(|tile| Some((tile.id()?, tile.publication().sent()))));
        }
    }

    /// Its number.
    pub fn id(&self) -> RobotId {
        self.id
    }

    /// Its port of the deployment.
    pub fn port(&self) -> PortId {
        self.port
    }

    /// What drives it, if it drives itself.
    pub fn pilot(&self) -> Option<&Pilot> {
        self.pilot.as_deref()
    }

    /// Its agent.
    pub fn agent(&self) -> &Agent<'_> {
        &self.agent
    }

    /// Whether it leaves a cell to the cameras at a moment of the run.
    pub fn is_left_to_cameras(&self, now: Instant, (x, y): (i32, i32)) -> bool {
        let Some(id) = TileId::of_cell(x, y) else { return false };
        let around = self.agent.fused_tiles().around(id, self.clock.local(now));
        let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
        around.covered.is_some_and(|rows| rows[within(y)] >> within(x) & 1 != 0)
    }

    /// Frames that the channel lost, both ways.
    pub fn frames_lost(&self) -> u64 {
        self.up.counters().lost + self.down.counters().lost
    }

    /// What telling the server of the same would have cost in other formats.
    pub fn comparison(&self) -> Comparison {
        let mut comparison = self.published.cost();
        comparison.add_scans(self.agent.statistics().mapped.into(), self.beams as u64);
        comparison
    }

    /// Where it believes that it has been, and when since the run began.
    pub fn path(&self) -> &[(Instant, Pose)] {
        &self.path
    }
}

/// Hears every frame that a robot or the server sends, before its channel does anything to it:
/// the robot, the direction, and the bytes.
pub type Tap<'t> = Box<dyn FnMut(RobotId, Direction, &[u8]) + 't>;

/// Hears every event of the deployment.
pub type Listener<'l> = Box<dyn FnMut(&deployment::Event) + 'l>;

/// A deployment and its robots, on one virtual clock.
pub struct Fleet<'b> {
    deployment: Deployment,
    robots: Vec<Robot<'b>>,
    keeper: Option<Keeper>,
    /// Since the run began.
    now: Instant,
    frame: Vec<u8>,
    tap: Option<Tap<'b>>,
    listener: Option<Listener<'b>>,
}

/// How long a run goes on after the last event, unless all hold the same map before.
const PATIENCE: Duration = Duration::from_secs(120);

impl<'b> Fleet<'b> {
    /// A robot for each configuration, at a port of its own; `memory` has one entry for each as
    /// well.
    ///
    /// # Errors
    /// [`ConfigError`].
    pub fn new(
        configs: &[Config],
        memory: &'b mut [AgentMemory],
        faults: Faults,
        seed: u64,
        mut deployment: Deployment,
    ) -> Result<Self, ConfigError> {
        let robots = configs.iter().zip(memory).map(|(config, memory)| {
            let id = config.robot;
            let wire = |way: u64| {
                FaultWire::new(faults, seed.wrapping_mul(0x1_0001) ^ u64::from(id.0) << 8 ^ way)
            };
            Ok(Robot {
                id,
                port: deployment.open_port(),
                beams: memory.beams.len(),
                clock: RobotClock::of(id, seed),
                agent: Agent::new(*config, memory.lend())?,
                pilot: None,
                up: wire(1),
                down: wire(2),
                path: Vec::new(),
                published: Published::default(),
                bytes_noted: 0,
            })
        });
        let robots = robots.collect::<Result<_, ConfigError>>()?;
        Ok(Self {
            deployment,
            robots,
            keeper: None,
            now: Instant(0),
            frame: vec![0; MAX_FRAME],
            tap: None,
            listener: None,
        })
    }

    /// Has what the deployment hands out written to a file from now on.
    pub fn keep(&mut self, keeper: Keeper) {
        self.keeper = Some(keeper);
    }

    /// Has every frame of the links heard from now on.
    pub fn tap(&mut self, tap: Tap<'b>) {
        self.tap = Some(tap);
    }

    /// Has every event of the deployment heard from now on.
    pub fn listen(&mut self, listener: Listener<'b>) {
        self.listener = Some(listener);
    }

    /// Lets a robot drive itself, and explore; if it is to stop for scans, where its gate opens.
    pub fn let_drive(&mut self, robot: RobotId, config: drive::Config, stops: bool) {
        if let Some(robot) = self.robots.iter_mut().find(|it| it.id == robot) {
            let mut pilot = Box::new(Pilot::new(config));
            if stops {
                pilot.stop_for_scans(Stops::new(robot.agent.config().gate));
            }
            robot.pilot = Some(pilot);
            self.deployment.explore(robot.id, true);
        }
    }

    /// The deployment.
    pub fn deployment(&self) -> &Deployment {
        &self.deployment
    }

    /// Its server.
    pub fn server(&self) -> &Server {
        self.deployment.server()
    }

    /// The robots.
    pub fn robots(&self) -> &[Robot<'b>] {
        &self.robots
    }

    /// The time since the run began.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// How long the run has lasted.
    pub fn elapsed(&self) -> Duration {
        self.now.since(Instant(0))
    }

    /// Runs until the stage has ended and all hold the same map, or until patience ends. Returns
    /// whether they do. `watch` sees the fleet after every event.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn run(
        &mut self,
        stage: &mut dyn Stage,
        mut watch: impl FnMut(&Self),
    ) -> Result<bool, StoreError> {
        while let Some(next) = stage.next_event() {
            self.run_until(next)?;
            while let Some(event) = stage.poll(self.now) {
                if let Event::Drive { robot } = event {
                    if let Some(command) = self.drive(robot) {
                        stage.drive(robot, command);
                    }
                } else {
                    self.happen(event);
                }
            }
            self.drain()?;
            watch(self);
        }
        let end = self.now + PATIENCE;
        while !self.has_converged() && self.now < end {
            self.run_until(self.now + Duration::from_millis(100))?;
        }
        Ok(self.has_converged())
    }

    /// Lets all that is due before `until` happen; then it is `until`.
    fn run_until(&mut self, until: Instant) -> Result<(), StoreError> {
        while let Some(next) = self.next_due().filter(|&next| next < until) {
            self.now = self.now.max(next);
            self.deliver();
            self.drain()?;
        }
        self.now = self.now.max(until);
        Ok(())
    }

    /// When a frame arrives, or a robot or the deployment wants to come back.
    fn next_due(&self) -> Option<Instant> {
        let robots = self.robots.iter().flat_map(|robot| {
            [
                robot.up.next_delivery(),
                robot.down.next_delivery(),
                Some(robot.clock.server(robot.agent.poll_timeout())),
            ]
        });
        robots.chain([self.deployment.poll_timeout(self.now)]).flatten().min()
    }

    fn deliver(&mut self) {
        let now = self.now;
        for robot in &mut self.robots {
            while let Some(bytes) = robot.up.poll(now) {
                let is_open = self.deployment.receive(robot.port, &bytes, now);
                debug_assert!(is_open.is_ok());
            }
            let local = robot.clock.local(now);
            while let Some(bytes) = robot.down.poll(now) {
                robot.agent.receive(&bytes, local);
            }
            robot.agent.timeout(local);
        }
        self.deployment.timeout(now);
    }

    /// What the wheels of a robot shall do, if it drives itself.
    fn drive(&mut self, robot: usize) -> Option<DriveCommand> {
        let robot = self.robots.get_mut(robot)?;
        let local = robot.clock.local(self.now);
        Some(robot.pilot.as_mut()?.step(&mut robot.agent, local))
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Drive { .. } => {}
            Event::Scan { robot, readings } => {
                let Some(robot) = self.robots.get_mut(robot) else { return };
                let local = robot.clock.local(self.now);
                let pilot = &mut robot.pilot;
                let is_taken =
                    pilot.as_mut().is_none_or(|pilot| pilot.takes_scan(&robot.agent, local));
                if is_taken && let Err(error) = robot.agent.scan(local, &readings, local) {
                    // The agent counts them.
                    log::debug!("robot {}: a scan is not taken: {error:?}", robot.id.0);
                }
                if let Some(pilot) = &mut robot.pilot {
                    pilot.scan(&robot.agent, &readings, local);
                }
                let pose = robot.agent.pose();
                robot.path.extend(pose.map(|(at, pose)| (self.deployment.since_began(at), pose)));
            }
            Event::Odometry { robot, pose } => {
                let Some(robot) = self.robots.get_mut(robot) else { return };
                let local = robot.clock.local(self.now);
                robot.agent.odometry(local, pose, local);
            }
            Event::Frame(frame) => self.deployment.frame(frame, self.now),
            Event::Observation(observation) => self.deployment.observe(observation),
        }
    }

    /// Drains the outputs of all, until none has any left.
    fn drain(&mut self) -> Result<(), StoreError> {
        let now = self.now;
        if let Some(keeper) = &mut self.keeper {
            keeper.keep(&mut self.deployment, now)?;
        }
        let mut hear = |robot, direction, frame: &[u8]| {
            if let Some(tap) = &mut self.tap {
                tap(robot, direction, frame);
            }
        };
        for robot in &mut self.robots {
            let (id, local) = (robot.id, robot.clock.local(now));
            while let Some(len) = robot.agent.poll_transmit(local, &mut self.frame[..DEFAULT_FRAME])
            {
                hear(id, Direction::ToServer, &self.frame[..len]);
                robot.up.send(now, &self.frame[..len]);
            }
            robot.take_note();
        }
        while let Some((port, len)) = self.deployment.poll_transmit(now, &mut self.frame) {
            if let Some(robot) = self.robots.iter_mut().find(|robot| robot.port == port) {
                hear(robot.id, Direction::ToRobot, &self.frame[..len]);
                robot.down.send(now, &self.frame[..len]);
            }
        }
        while let Some((_, event)) = self.deployment.poll_event() {
            log::log!(event.level(), "{event}");
            if let Some(listener) = &mut self.listener {
                listener(&event);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robots_clock_comes_back_when_it_was_asked_to() {
        for id in 0..50 {
            let clock = RobotClock::of(RobotId(id), 7);
            for server in [0, 1, 999, 1_000_000, 3_600_000_000] {
                let local = clock.local(Instant(server));
                let back = clock.server(local);
                assert!(clock.local(back) >= local && back.0 <= server);
            }
        }
    }
}
