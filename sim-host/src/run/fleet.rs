//! Robots and the server, joined by channels under virtual time.
//!
//! Nothing here waits: the clock jumps from event to event, each robot and the server come back
//! when they asked to, and the same seed gives the same bytes.

use ubimap_agent::{
    Config, ConfigError, Memory,
    drive::{DriveCommand, Driving},
};
use ubimap_protocol::{
    frame::{Direction, MAX_FRAME},
    tile::{Epoch, Layer, Stamp, tile_hash},
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};

use super::{
    RunError,
    heap::Heap,
    keeper::{self, Keeper},
    member::Member,
};
use crate::{
    camera::{Frame, Observation, Sighting},
    channel::fault::Faults,
    perception::Observer,
    server::{Footprint, Server},
    store::StoreError,
};

/// Something that happens at a moment of the server's clock.
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

    /// A robot's wheels shall do this from `moment` on, by the clock of the events.
    fn drive(&mut self, _moment: Instant, _robot: usize, _command: DriveCommand) {}
}

/// Hears every frame that a robot or the server sends, before its channel does anything to it:
/// which robot's channel, which way, and the bytes.
pub type Tap<'t> = Box<dyn FnMut(RobotId, Direction, &[u8]) + 't>;

/// Hears what every frame of a camera says, before the server does.
pub type Watch<'w> = Box<dyn FnMut(&Observation) + 'w>;

/// All robots and the server.
pub struct Fleet<'b> {
    server: Server,
    observer: Option<Observer>,
    /// What the cameras localised, and when by the run's clock.
    sightings: Vec<(Instant, Sighting)>,
    robots: Vec<Member<'b>>,
    keeper: Option<Keeper>,
    /// When the run began.
    began: Instant,
    now: Instant,
    frame: Vec<u8>,
    tap: Option<Tap<'b>>,
    watch: Option<Watch<'b>>,
}

/// A run goes on for so long after the last event, if not all hold the same map before.
const PATIENCE: Duration = Duration::from_secs(120);

impl<'b> Fleet<'b> {
    /// A robot for each configuration; `memory` has one entry for each as well. With a keeper the
    /// server and its clock go on from what is in the file.
    ///
    /// # Errors
    /// [`RunError::Robot`] and [`RunError::Store`].
    pub fn new(
        configs: &[Config<Option<Driving>>],
        memory: &'b mut [Memory<Heap, Option<Driving>>],
        faults: Faults,
        resolution: Millimetres,
        seed: u64,
        keeper: Option<Keeper>,
    ) -> Result<Self, RunError> {
        let robots = configs
            .iter()
            .zip(memory)
            .map(|(config, memory)| Member::new(*config, memory, faults, seed))
            .collect::<Result<Vec<_>, ConfigError>>()?;
        let server = keeper::server(keeper.as_ref(), resolution, Epoch(1), robots.len())?;
        let began = keeper.as_ref().map_or(Instant(0), Keeper::begins);
        let frame = vec![0; MAX_FRAME];
        Ok(Self {
            server,
            observer: None,
            sightings: Vec::new(),
            robots,
            keeper,
            began,
            now: began,
            frame,
            tap: None,
            watch: None,
        })
    }

    /// Has the frames of cameras looked at.
    pub fn look_through(&mut self, observer: Observer) {
        self.observer = Some(observer);
    }

    /// What the cameras localised in their frames, and when each was captured, from the beginning
    /// of the run.
    pub fn sightings(&self) -> &[(Instant, Sighting)] {
        &self.sightings
    }

    /// Has every frame of the links heard from now on.
    pub fn tap(&mut self, tap: Tap<'b>) {
        self.tap = Some(tap);
    }

    /// Has every observation heard from now on.
    pub fn watch(&mut self, watch: Watch<'b>) {
        self.watch = Some(watch);
    }

    /// The server.
    pub fn server(&self) -> &Server {
        &self.server
    }

    /// What a robot takes up, for the others to know.
    pub fn set_footprint(&mut self, robot: RobotId, footprint: Footprint) {
        self.server.set_footprint(robot, footprint);
    }

    /// Lets the server say where robots drive: a frontier is in view from so far, by sensors that
    /// see so far, both in metres, and looked at for so long.
    pub fn coordinate(&mut self, view_m: f64, range_m: f64, look: Duration) {
        self.server.coordinate(view_m, range_m, look);
    }

    /// Lets the server say where a robot drives.
    pub fn explore(&mut self, robot: RobotId) {
        self.server.explore(robot);
    }

    /// The server leaves the robots' constant errors as they are, and tells nobody in blind ground
    /// where it is.
    pub fn leave_errors(&mut self) {
        self.server.leave_errors();
    }

    /// The robots.
    pub fn robots(&self) -> &[Member<'b>] {
        &self.robots
    }

    /// When the run began by the server's clock: zero, unless the server goes on from a file.
    pub fn began(&self) -> Instant {
        self.began
    }

    /// How long the run has lasted.
    pub fn elapsed(&self) -> Duration {
        self.now.since(self.began)
    }

    /// The server's time.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// Runs until the stage has ended and all hold the same map, or until patience ends. Returns
    /// whether they do. `watch` sees it after every event.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn run(
        &mut self,
        stage: &mut dyn Stage,
        mut watch: impl FnMut(&Self),
    ) -> Result<bool, StoreError> {
        while let Some(next) = stage.next_event() {
            self.run_until(self.began + next.since(Instant(0)), stage)?;
            let now = Instant(0) + self.elapsed();
            while let Some(event) = stage.poll(now) {
                self.happen(event);
            }
            self.drain();
            watch(self);
        }
        let end = self.now + PATIENCE;
        while !self.has_converged() && self.now < end {
            self.run_until(self.now + Duration::from_millis(100), stage)?;
        }
        Ok(self.has_converged())
    }

    /// Lets all that is due before `until` happen; then it is `until`.
    fn run_until(&mut self, until: Instant, stage: &mut dyn Stage) -> Result<(), StoreError> {
        while let Some(next) = self.next_due().filter(|&next| next < until) {
            self.now = self.now.max(next);
            self.deliver();
            self.turn_wheels(stage);
            if let Some(keeper) = &mut self.keeper {
                keeper.keep(&mut self.server, self.now)?;
            }
            self.drain();
        }
        self.now = self.now.max(until);
        Ok(())
    }

    /// When a frame arrives, or a robot or the server wants to come back.
    fn next_due(&self) -> Option<Instant> {
        let robots = self.robots.iter().enumerate().flat_map(|(port, robot)| {
            [robot.poll_timeout(), self.server.poll_timeout(port, self.now)]
        });
        let commit = self.keeper.as_ref().map(|keeper| keeper.poll_timeout(&self.server));
        robots.chain(commit).flatten().min()
    }

    fn deliver(&mut self) {
        let now = self.now;
        for (port, robot) in self.robots.iter_mut().enumerate() {
            while let Some(bytes) = robot.poll_up(now) {
                let known = self.server.receive(port, &bytes, now);
                debug_assert!(known.is_ok());
            }
            robot.deliver(now);
        }
        self.server.timeout(now);
    }

    /// Lets the wheels do what the robots say.
    fn turn_wheels(&mut self, stage: &mut dyn Stage) {
        let now = Instant(0) + self.elapsed();
        for (index, robot) in self.robots.iter_mut().enumerate() {
            if let Some(command) = robot.poll_command() {
                stage.drive(now, index, command);
            }
        }
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Scan { robot, readings } => {
                if let Some(robot) = self.robots.get_mut(robot) {
                    robot.scan(&readings, self.now);
                }
            }
            Event::Odometry { robot, pose } => {
                if let Some(robot) = self.robots.get_mut(robot) {
                    robot.odometry(pose, self.now);
                }
            }
            Event::Frame(frame) => self.look(frame),
            Event::Observation(mut observation) => {
                observation.captured = self.began + observation.captured.since(Instant(0));
                self.observe(&observation);
            }
        }
    }

    fn look(&mut self, mut frame: Frame) {
        let Some(observer) = &mut self.observer else { return };
        let since_began = frame.captured;
        frame.captured = self.began + since_began.since(Instant(0));
        let told = self.server.whereabouts(frame.captured);
        let (observation, fault) = observer.observe(&frame, self.now, told);
        if let Some(fault) = fault {
            log::warn!("{fault}");
        }
        while let Some((captured, event)) = observer.poll_event() {
            self.server.sighting_event(captured, event);
        }
        self.sightings.extend(observation.robots.iter().map(|&it| (since_began, it)));
        self.observe(&observation);
    }

    fn observe(&mut self, observation: &Observation) {
        if let Some(watch) = &mut self.watch {
            watch(observation);
        }
        self.server.observe(observation);
    }

    /// Drains the outputs of all, until none has any left.
    fn drain(&mut self) {
        let now = self.now;
        for (port, robot) in self.robots.iter_mut().enumerate() {
            let id = robot.id();
            let mut hear = |direction, frame: &[u8]| {
                if let Some(tap) = &mut self.tap {
                    tap(id, direction, frame);
                }
            };
            while let Some(len) = robot.poll_transmit(now, &mut self.frame) {
                hear(Direction::ToServer, &self.frame[..len]);
            }
            while let Some(len) = self.server.poll_transmit(port, now, &mut self.frame) {
                hear(Direction::ToRobot, &self.frame[..len]);
                robot.send_down(now, &self.frame[..len]);
            }
        }
        self.server.age(now);
    }

    /// Whether the server holds the newest version of every tile that each robot has published,
    /// and every fused tile that a robot holds is the server's newest, hash for hash; and all of it
    /// is on disk, if the server keeps anything.
    pub fn has_converged(&self) -> bool {
        !self.server.has_unsaved()
            && self.robots.iter().all(|robot| {
                robot.robot().is_idle()
                    && self.server.is_level(robot.id())
                    && self.server_holds_all_of(robot)
                    && self.all_held_is_newest(robot)
            })
    }

    fn server_holds_all_of(&self, robot: &Member<'_>) -> bool {
        let Some(layer) = self.server.layer(robot.id()) else {
            return robot.robot().own_tiles().tiles().next().is_none();
        };
        robot.robot().own_tiles().tiles().all(|tile| {
            let stamp = Stamp { epoch: tile.epoch(), version: tile.publication().version() };
            let held = tile.id().and_then(|id| layer.held(id, tile.epoch()));
            held.is_some_and(|(held, cells)| {
                held == stamp && tile_hash(cells) == tile_hash(tile.publication().sent())
            })
        })
    }

    fn all_held_is_newest(&self, robot: &Member<'_>) -> bool {
        robot.robot().fused_tiles().tiles(Layer::Fused).all(|(id, replica)| {
            let newest = self.server.fused().get(id);
            newest.is_some_and(|(version, cells)| {
                let stamp = Stamp { epoch: self.server.epoch(), version };
                !replica.is_partial()
                    && replica.stamp() == stamp
                    && tile_hash(replica.tile()) == tile_hash(cells)
            })
        })
    }
}
