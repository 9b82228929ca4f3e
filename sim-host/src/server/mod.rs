//! The camera server: a session for each robot, their shared map, and the coordinator.
//!
//! | file or folder | content |
//! |---|---|
//! | `ports`, `port`, `inflow` | the ports, their links, and their rate limit |
//! | `keyring` | keys of robots, and which of their Hellos are new |
//! | `inbox` | passes robots' messages on |
//! | `session` | the state of the conversation with one robot |
//! | `surroundings`, `shared_map` | positions of robots and obstacles; layers and fused map |
//! | `correction` | constant errors of robots, and pose fixes in blind ground |
//! | [`coordination`], `dispatch` | decides who drives where |
//! | `unsaved`, `records`, `damaged` | state to be stored on disk, and what was damaged there |
//! | `voided` | tiles that have lost a robot's observations |
//! | `events`, `queries` | events, and read access |

mod command;
pub mod coordination;
mod correction;
mod damaged;
mod dispatch;
mod event_log;
mod events;
mod inbox;
mod inflow;
mod keyring;
mod port;
mod ports;
mod queries;
mod records;
mod session;
mod shared_map;
mod snapshot;
mod surroundings;
mod unread;
mod unsaved;
mod voided;

use std::collections::BTreeSet;

use ubimap_protocol::{
    frame::{Attempt, Key},
    link::{Terms, Verdict},
    message::{Hello, RefusalReason, Stop},
    tile::Epoch,
    time::Instant,
    units::{Millimetres, RobotId},
};

use self::{
    coordination::{DrivableFloor, GoalError, Settings},
    correction::Corrections,
    damaged::Damaged,
    dispatch::Dispatch,
    events::Events,
    inbox::{Inbox, Taken},
    port::Brought,
    ports::{Greeted, Ports},
    shared_map::SharedMap,
    snapshot::Snapshot,
    surroundings::Surroundings,
    unsaved::Unsaved,
    voided::Voided,
};
use crate::{
    camera::{Observation, Sighting},
    grid::Label,
    mapping::{CoverageLayer, Limit, PriorLayer},
    perception::robots::SightingEvent,
};

pub use crate::perception::Footprint;
pub use command::Command;
pub use event_log::{EventLog, LoggedEvent};
pub use events::{Event, EventKind, PersonEvent, RobotEvent, Tally, about_number, described};
pub use port::{MessageCounters, Policy};
pub use ports::{CommandError, NoSuchPort};
pub use unread::Unread;

/// Maximum number of robots that the server knows at once, including those in the store.
pub const MAX_ROBOTS: usize = 1_024;

/// The camera server's sans-IO core. It follows the driving rule of the crate: after every input
/// drain [`Server::poll_transmit`] for each port and [`Server::poll_event`], then call
/// [`Server::timeout`] at [`Server::poll_timeout`].
#[derive(Debug)]
pub struct Server {
    terms: Terms,
    ports: Ports,
    map: SharedMap,
    coverage: CoverageLayer,
    surroundings: Surroundings,
    corrections: Corrections,
    /// `None` without a coordinator.
    dispatch: Option<Dispatch>,
    events: Events,
    /// The limits that robots have exceeded and that were reported already.
    exceeded: BTreeSet<(RobotId, Limit)>,
    unsaved: Unsaved,
    damaged: Damaged,
    voided: Voided,
}

impl Server {
    /// Creates a server with an empty map and `ports` ports without keys, numbered from zero.
    pub fn new(terms: Terms, ports: usize) -> Self {
        let mut server = Self {
            terms,
            ports: Ports::new(terms.server_epoch),
            map: SharedMap::default(),
            coverage: CoverageLayer::default(),
            surroundings: Surroundings::default(),
            corrections: Corrections::default(),
            dispatch: None,
            events: Events::default(),
            exceeded: BTreeSet::new(),
            unsaved: Unsaved::new(terms.stores),
            damaged: Damaged::default(),
            voided: Voided::default(),
        };
        for _ in 0..ports {
            server.open_port(Policy::Open);
        }
        server
    }

    /// Sets the number of the next session; by default it is derived from the server's epoch. It
    /// should be random, so that robots can't mistake this run of the server for an earlier one.
    pub fn number_sessions_from(&mut self, next: u32) {
        self.ports.number_sessions_from(next);
    }

    /// Sets the salt of the next answer on keyed ports. It must be random: under one key no two lives
    /// of the server may use a salt twice. The default is derived from the server's epoch.
    pub fn salt_from(&mut self, next: u64) {
        self.ports.salt_from(next);
    }

    /// Sets where things of a class stand, which weighs how soon claims are forgotten. Call it before
    /// anything is restored or observed.
    pub fn expect(&mut self, labels: &[Label]) {
        self.map.expect(PriorLayer::new(labels, self.terms.resolution));
    }

    /// Gives a robot a key, with which it can open sessions on keyed ports. If it had another one,
    /// its session there ends.
    pub fn set_key(&mut self, robot: RobotId, key: Key) {
        self.ports.set_key(robot, key);
    }

    /// Takes a robot's key away; its session on a keyed port ends. Returns whether there was one.
    pub fn retire_key(&mut self, robot: RobotId) -> bool {
        self.ports.retire_key(robot)
    }

    /// Opens a port and returns its number. Numbers count up and are not reused.
    pub fn open_port(&mut self, policy: Policy) -> usize {
        self.ports.open(policy)
    }

    /// Closes a port. Ends the session of the robot there; the robot's next session, on any port,
    /// continues from the same state.
    ///
    /// # Errors
    /// [`NoSuchPort`] if the port is not open.
    pub fn close_port(&mut self, port: usize) -> Result<(), NoSuchPort> {
        self.ports.close(port)
    }

    /// Processes bytes received at a port, in pieces of any size. Bytes beyond the maximum rate of
    /// an agent are dropped, as on a bad link.
    ///
    /// # Errors
    /// [`NoSuchPort`] if the port is not open.
    pub fn receive(&mut self, port: usize, bytes: &[u8], now: Instant) -> Result<(), NoSuchPort> {
        let index = port;
        let port = self.ports.get_mut(index)?;
        let (mut bytes, floods) = port.admit(bytes, now);
        if let Some(robot) = port.robot().filter(|_| floods) {
            self.events.add(now, Event::Robot(RobotEvent::Floods(robot)));
        }
        loop {
            if let Some(robot) = self.ports.poll_candidate(index, bytes, now)? {
                self.joined(index, robot, now);
            }
            match self.ports.receive(index, &mut bytes, now)? {
                None => return Ok(()),
                Some(Brought::Nothing) => {}
                Some(Brought::Dropped(fault)) => {
                    self.events.add_from(index, now, Event::Dropped(index, fault));
                }
                Some(Brought::Unread(unread)) => {
                    self.events.add_from(index, now, Event::Unread(index, unread));
                }
                Some(Brought::Hello(hello)) => self.greet(index, &hello, now)?,
                Some(Brought::SealedHello(attempt, hello)) => {
                    self.greet_sealed(index, (attempt, &hello), now)?;
                }
                Some(Brought::ForgedHello(robot)) => {
                    self.ports.get_mut(index)?.judge(Verdict::Forged);
                    self.no_key(index, robot, now);
                }
                Some(Brought::Stray(stray, fault)) => {
                    self.events.add_from(index, now, Event::Dropped(index, fault));
                    self.no_key(index, stray.robot, now);
                    self.ports.stray(index, stray, now)?;
                }
                Some(Brought::Messages(session, messages)) => {
                    let robot = session.robot();
                    let barrier = self.corrections.retiring(robot);
                    let layer = self.map.limited_layer_mut(robot, barrier);
                    let taken = Inbox::new(session, layer, &mut self.surroundings);
                    let taken = taken.take(messages, now);
                    self.unsaved.came(session, layer, &taken.updated);
                    self.ports.get_mut(index)?.taken(&taken.unread, taken.late);
                    self.taken((index, robot), taken, now);
                }
            }
        }
    }

    fn greet(&mut self, port: usize, hello: &Hello, now: Instant) -> Result<(), NoSuchPort> {
        let robot = hello.robot;
        if !self.has_room_for(robot) {
            self.events.add_from(port, now, Event::Robot(RobotEvent::TooMany(robot)));
            return self.ports.refuse(port, hello, RefusalReason::TooManyRobots);
        }
        let first_epoch = self.map.next_epoch(robot);
        match self.ports.greet(port, hello, (&self.terms, first_epoch), now)? {
            Greeted::Joined => {
                self.map.layer_mut(robot);
                self.joined(port, robot, now);
            }
            Greeted::Refused(reason) => {
                self.events.add_from(port, now, Event::Refused(*hello, reason));
            }
            Greeted::Answered | Greeted::Old { .. } => {}
        }
        Ok(())
    }

    fn greet_sealed(
        &mut self,
        port: usize,
        (attempt, hello): (Attempt, &Hello),
        now: Instant,
    ) -> Result<(), NoSuchPort> {
        let robot = hello.robot;
        if !self.has_room_for(robot) {
            self.events.add_from(port, now, Event::Robot(RobotEvent::TooMany(robot)));
            let reason = RefusalReason::TooManyRobots;
            return self.ports.refuse_sealed(port, (attempt, hello), reason, now);
        }
        let offer = (&self.terms, self.map.next_epoch(robot));
        match self.ports.greet_sealed(port, (attempt, hello), offer, now)? {
            Greeted::Refused(reason) => {
                self.events.add_from(port, now, Event::Refused(*hello, reason));
            }
            Greeted::Old { tell: true } => {
                self.events.add_from(port, now, Event::Robot(RobotEvent::OldAttempt(robot)));
            }
            Greeted::Joined | Greeted::Answered | Greeted::Old { .. } => {}
        }
        Ok(())
    }

    /// Tells the operator, once, that a robot on a keyed port has no key.
    fn no_key(&mut self, port: usize, robot: RobotId, now: Instant) {
        if self.ports.tells_of(robot) {
            self.events.add_from(port, now, Event::Robot(RobotEvent::NoKey(robot)));
        }
    }

    /// Handles the beginning of a robot's session.
    fn joined(&mut self, port: usize, robot: RobotId, now: Instant) {
        self.events.add_from(port, now, Event::Joined(robot, port));
        let Some(session) = self.ports.session_mut(robot) else { return };
        self.damaged.joined(session, now);
        if session.is_of_new_life()
            && let Some(dispatch) = &mut self.dispatch
        {
            dispatch.booted(robot);
        }
    }

    /// Whether a robot is known or can be added. If the maximum is reached, forgets robots without
    /// a session that have drawn nothing.
    fn has_room_for(&mut self, robot: RobotId) -> bool {
        if self.map.layer(robot).is_none() && self.map.layers().len() >= MAX_ROBOTS {
            let known: Vec<RobotId> = self.map.layers().keys().copied().collect();
            for robot in known {
                if self.ports.session(robot).is_none() && self.map.forget(robot) {
                    self.corrections.forget(robot);
                    self.surroundings.forget(robot);
                    self.ports.forget(robot);
                    self.voided.forget(robot);
                }
            }
        }
        self.map.layer(robot).is_some() || self.map.layers().len() < MAX_ROBOTS
    }

    /// Acts on the messages that were received from the robot at a port.
    fn taken(&mut self, (port, robot): (usize, RobotId), taken: Taken, now: Instant) {
        self.map.drew(robot, &taken.updated.tiles);
        self.damaged.came(robot, &taken.updated.complete);
        if let Some(limit) = taken.updated.refused
            && self.exceeded.insert((robot, limit))
        {
            let event = match limit {
                Limit::Robot => RobotEvent::Floods(robot),
                Limit::AllRobots => RobotEvent::NoRoom(robot),
            };
            self.events.add_from(port, now, Event::Robot(event));
        }
        if let Some(dispatch) = &mut self.dispatch {
            taken.codes().for_each(|code| dispatch.event(robot, code, now));
        }
        for unread in taken.unread {
            self.events.add_from(port, now, Event::Unread(port, unread));
        }
        for event in taken.events {
            self.events.add_from(port, now, Event::Reported(robot, event));
        }
        if let Some(place) = taken.hearsay {
            self.corrections.seek(robot, &place);
        }
        let must_ask = self.voided.concerns(robot) && self.is_level(robot);
        let Some(session) = self.ports.session_mut(robot) else { return };
        if must_ask {
            self.voided.ask(session);
        }
        let is_held_up = self.unsaved.holds_up(robot);
        if let Some(record) = self.corrections.advance(session, &self.map, is_held_up, now) {
            let retired = self.map.retire(robot, record.first_epoch);
            self.unsaved.folded(robot, &retired.folded);
            self.corrections.void(robot, &mut self.map, self.terms.resolution);
            if !retired.tiles.is_empty() {
                self.voided.add(&retired.tiles);
            }
            self.unsaved.add_cure(record);
        }
    }

    /// Processes the observation of a camera frame.
    pub fn observe(&mut self, observation: &Observation) {
        let captured = observation.captured;
        for &sighting in &observation.robots {
            let Sighting { robot, pose: seen, .. } = sighting;
            let pose = self.corrections.fix(robot, captured, seen);
            self.surroundings.saw(robot, captured, pose);
            let (footprint, side) = (self.surroundings.footprint(robot), self.terms.resolution);
            // Cells that the robot covers only partly may contain a wall next to it.
            let within = |margin| footprint.cells(pose, Millimetres(margin), side);
            self.map.stands(robot, captured, within(-side.0), within(side.0));
            if let Some(session) = self.ports.session_mut(robot) {
                session.fix(captured, Sighting { pose, ..sighting });
            }
        }
        self.coverage.observe(observation);
        let changed = self.map.see(observation);
        self.surroundings.observe(observation, self.terms.resolution);
        while let Some(lying) = self.surroundings.poll_lying() {
            self.events.add(lying.moment, Event::Person(lying.into()));
        }
        self.map.changed(&changed);
    }

    /// Forgets the cells that a camera has seen after `since`: it was knocked.
    pub fn forget_camera(&mut self, camera: usize, since: Instant) {
        let changed = self.map.forget_camera(camera, since);
        self.map.changed(&changed);
    }

    /// Reports that a sighting in the frame captured at `captured` can't be a pose.
    pub fn sighting_event(&mut self, captured: Instant, event: SightingEvent) {
        self.events.add(captured, Event::Sighting(event));
    }

    /// Sends a command to a robot.
    ///
    /// # Errors
    /// Every [`CommandError`].
    pub fn command(&mut self, robot: RobotId, command: Command) -> Result<(), CommandError> {
        let held = if let Command::Stop(Stop { stop, .. }) = command { Some(stop) } else { None };
        self.ports.command(robot, command)?;
        if let (Some(dispatch), Some(held)) = (&mut self.dispatch, held) {
            dispatch.hold(robot, held);
        }
        Ok(())
    }

    /// Tells every robot with a session to stop. The command has the highest number, so no later
    /// Stop of this server overrides it.
    pub fn stop_robots(&mut self) {
        let robots: Vec<RobotId> = self.ports.sessions().map(|session| session.robot()).collect();
        for robot in robots {
            // A stop fits into every frame, and the robot has a session.
            let _ = self.command(robot, Command::Stop(Stop { number: u32::MAX, stop: true }));
        }
    }

    /// Starts a coordinator, which decides where robots drive. The server replaces the resolution
    /// and `first_path` in the settings, so that path numbers differ from those of its earlier
    /// runs.
    pub fn coordinate(&mut self, settings: Settings) {
        let Terms { resolution, server_epoch, .. } = self.terms;
        // Robots only compare path numbers within an epoch.
        let first_path = server_epoch.wrapping_shl(20);
        self.dispatch = Some(Dispatch::new(Settings { resolution, first_path, ..settings }));
    }

    /// Keeps the robots of the coordinator on a floor. No effect without a coordinator.
    pub fn keep_to(&mut self, floor: DrivableFloor) {
        if let Some(dispatch) = &mut self.dispatch {
            dispatch.keep_to(floor);
        }
    }

    /// Lets a robot explore while it has no goal, or stops it from exploring. No effect without a
    /// coordinator.
    pub fn explore(&mut self, robot: RobotId, explores: bool) {
        if let Some(dispatch) = &mut self.dispatch {
            dispatch.explore(robot, explores);
        }
    }

    /// Sends a robot to a position in `map`, in metres.
    ///
    /// # Errors
    /// Every [`GoalError`]; [`GoalError::UnknownRobot`] without a coordinator.
    pub fn goal(
        &mut self,
        robot: RobotId,
        place_m: [f64; 2],
        now: Instant,
    ) -> Result<(), GoalError> {
        let dispatch = self.dispatch.as_mut().ok_or(GoalError::UnknownRobot(robot))?;
        dispatch.goal(robot, place_m, now)
    }

    /// Turns off the correction of constant errors and the fixes in blind ground, for comparisons.
    pub fn leave_errors(&mut self) {
        self.corrections.turn_off();
    }

    /// Sets a robot's footprint, which is sent to the others.
    pub fn set_footprint(&mut self, robot: RobotId, footprint: Footprint) {
        self.surroundings.set_footprint(robot, footprint);
    }

    /// Does all work that is due at `now`, except for sending. Work that takes milliseconds is done
    /// in pieces, so that messages are not delayed; [`Server::poll_timeout`] is `now` until all are
    /// done.
    pub fn timeout(&mut self, now: Instant) {
        self.events.timeout(now);
        let is_reachable = |robot| self.ports.session(robot).is_some_and(|it| it.is_reachable(now));
        while let Some((robot, tiles)) = self.damaged.poll_lost(is_reachable, now) {
            self.events.add(now, Event::Robot(RobotEvent::LostTiles(robot, tiles)));
        }
        let waiting = self.corrections.poll_waiting();
        if let Some(session) = waiting.and_then(|robot| self.ports.session_mut(robot)) {
            self.corrections.look(session, &mut self.map, self.terms.resolution, now);
        }
        self.corrections.follow(&mut self.map, self.terms.resolution, now);
        self.dispatch(now);
    }

    fn dispatch(&mut self, now: Instant) {
        let Some(mut dispatch) = self.dispatch.take() else { return };
        let is_reachable = |robot| self.ports.session(robot).is_some_and(|it| it.is_reachable(now));
        if dispatch.tick(&self.snapshot(), is_reachable, now) {
            while let Some((robot, notice)) = dispatch.poll_notice() {
                self.events.add(now, Event::Drive(robot, notice));
            }
            while let Some((robot, command)) = dispatch.poll_command() {
                if let Err(error) = self.command(robot, command) {
                    // The coordinator sends the command again when the robot is back.
                    log::debug!("{error}");
                }
            }
        }
        self.dispatch = Some(dispatch);
    }

    /// Updates the map and the coverage to `now`.
    pub(crate) fn age(&mut self, now: Instant) {
        self.coverage.refresh(now);
        for robot in self.map.age(now) {
            self.events.add(now, Event::Robot(RobotEvent::Disagrees(robot)));
        }
    }

    /// Writes the next due frame of a port into `out`, which should have
    /// [`MAX_FRAME`](ubimap_protocol::frame::MAX_FRAME) bytes, and returns its length. Updates the
    /// map and the coverage to `now` first.
    #[must_use]
    pub fn poll_transmit(&mut self, port: usize, now: Instant, out: &mut [u8]) -> Option<usize> {
        self.age(now);
        let Self { terms, ports, map, coverage, surroundings, .. } = self;
        let epoch = Epoch(terms.server_epoch);
        let (fused, coverage) = (map.fused(), coverage.served());
        let snapshot = Snapshot { epoch, fused, coverage, surroundings };
        ports.get_mut(port).ok()?.poll_transmit(&snapshot, now, out)
    }

    /// Returns the oldest event and its time. Only the newest 1,000 are kept.
    #[must_use]
    pub fn poll_event(&mut self) -> Option<(Instant, Event)> {
        self.events.poll()
    }

    /// The deadline for the next calls of [`Server::timeout`] and, for this port,
    /// [`Server::poll_transmit`].
    pub fn poll_timeout(&self, port: usize, now: Instant) -> Option<Instant> {
        let port = self.ports.get(port).ok()?.poll_timeout(&self.snapshot(), now);
        port.into_iter().chain(self.poll_common_timeout(now)).min()
    }

    /// The earliest deadline of all ports.
    pub(crate) fn poll_any_timeout(&self, now: Instant) -> Option<Instant> {
        let snapshot = self.snapshot();
        let ports = self.ports.iter().filter_map(|port| port.poll_timeout(&snapshot, now));
        ports.chain(self.poll_common_timeout(now)).min()
    }

    /// The earliest deadline that does not belong to a port.
    fn poll_common_timeout(&self, now: Instant) -> Option<Instant> {
        let dispatch = self.dispatch.as_ref().map(Dispatch::poll_timeout);
        let waiting = self.corrections.has_waiting().then_some(now);
        let follow = self.corrections.poll_follow(now);
        let damaged = self.damaged.poll_timeout();
        let map = [self.coverage.poll_timeout(), self.map.poll_timeout()];
        let all = map.into_iter().chain([dispatch, waiting, follow, damaged]);
        all.flatten().min()
    }

    fn snapshot(&self) -> Snapshot<'_> {
        Snapshot {
            epoch: self.epoch(),
            fused: self.map.fused(),
            coverage: self.coverage.served(),
            surroundings: &self.surroundings,
        }
    }
}
