//! The camera server: a session for each robot, the map that they share, and who drives where.
//!
//! | file or folder | what |
//! |---|---|
//! | `ports`, `port`, `inflow` | where bytes come in and go out, and how many are read |
//! | `inbox` | what robots say, to the part that it is for |
//! | `session` | what one robot has said and is told |
//! | `surroundings`, `shared_map` | who and what is about; the layers and the map that they make |
//! | `correction` | constant errors that are cured, poses that are found in blind ground |
//! | [`coordination`], `dispatch` | who drives where |
//! | `unsaved`, `records` | what is to be kept on disk |
//! | `events`, `queries` | what somebody should know of, and may ask |

mod command;
pub mod coordination;
mod correction;
mod dispatch;
mod events;
mod inbox;
mod inflow;
mod port;
mod ports;
mod queries;
mod records;
mod session;
mod shared_map;
mod snapshot;
mod surroundings;
mod unsaved;

use std::collections::BTreeSet;

use ubimap_protocol::{
    link::Terms,
    message::Hello,
    tile::Epoch,
    time::Instant,
    units::{Millimetres, RobotId},
};

use self::{
    coordination::{GoalError, Settings},
    correction::Corrections,
    dispatch::Dispatch,
    events::Events,
    inbox::{Inbox, Taken},
    port::Brought,
    ports::{Greeted, Ports},
    shared_map::SharedMap,
    snapshot::Snapshot,
    surroundings::Surroundings,
    unsaved::Unsaved,
};
use crate::{
    camera::{Observation, Sighting},
    mapping::CoverageLayer,
    perception::robots::SightingEvent,
};

pub use crate::perception::Footprint;
pub use command::Command;
pub use events::{Event, EventLog, PersonEvent, RobotEvent, Tally, described};
pub use ports::{CommandError, NoSuchPort};

/// The camera server's sans-IO core. It follows the law of the crate: after every input drain
/// [`Server::poll_transmit`] for each port and [`Server::poll_event`], then come back at
/// [`Server::poll_timeout`] and call [`Server::timeout`].
#[derive(Debug)]
pub struct Server {
    terms: Terms,
    ports: Ports,
    map: SharedMap,
    coverage: CoverageLayer,
    surroundings: Surroundings,
    corrections: Corrections,
    /// `None` if nobody is told where to drive.
    dispatch: Option<Dispatch>,
    events: Events,
    /// Robots that draw more ground than there is.
    draws_too_much: BTreeSet<RobotId>,
    unsaved: Unsaved,
}

impl Server {
    /// A server with this many ports, numbered from zero, and an empty map.
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
            draws_too_much: BTreeSet::new(),
            unsaved: Unsaved::new(terms.stores),
        };
        for _ in 0..ports {
            server.open_port();
        }
        server
    }

    /// Opens a port and returns its number. Numbers count up and are never used again.
    pub fn open_port(&mut self) -> usize {
        self.ports.open()
    }

    /// Closes a port. The session of the robot there ends; its next one, on any port, continues
    /// from it.
    ///
    /// # Errors
    /// [`NoSuchPort`].
    pub fn close_port(&mut self, port: usize) -> Result<(), NoSuchPort> {
        self.ports.close(port)
    }

    /// Takes bytes that came in at a port, in pieces of any size. Bytes beyond the rate of any agent
    /// are dropped, as on a bad link.
    ///
    /// # Errors
    /// [`NoSuchPort`].
    pub fn receive(&mut self, port: usize, bytes: &[u8], now: Instant) -> Result<(), NoSuchPort> {
        let index = port;
        let port = self.ports.get_mut(index)?;
        let (mut bytes, floods) = port.admit(bytes, now);
        if let Some(robot) = port.robot().filter(|_| floods) {
            self.events.add(now, Event::Robot(RobotEvent::Floods(robot)));
        }
        loop {
            let port = self.ports.get_mut(index)?;
            match port.receive(&mut bytes, now) {
                None => return Ok(()),
                Some(Brought::Nothing) => {}
                Some(Brought::Hello(hello)) => self.greet(index, &hello, now)?,
                Some(Brought::Messages(session, messages)) => {
                    let robot = session.robot();
                    let layer = self.map.layer_mut(robot);
                    let taken = Inbox::new(session, layer, &mut self.surroundings);
                    let taken = taken.take(messages, now);
                    self.unsaved.came(session, layer, &taken.updated.complete);
                    port.taken(taken.unknown, taken.malformed);
                    self.taken(robot, taken, now);
                }
            }
        }
    }

    fn greet(&mut self, port: usize, hello: &Hello, now: Instant) -> Result<(), NoSuchPort> {
        let robot = hello.robot;
        let first_epoch = self.map.next_epoch(robot);
        match self.ports.greet(port, hello, (&self.terms, first_epoch), now)? {
            Greeted::Joined => self.events.add(now, Event::Joined(robot, port)),
            Greeted::Refused(reason) => self.events.add(now, Event::Refused(robot, reason)),
            Greeted::Known => {}
        }
        Ok(())
    }

    /// Goes on with what the messages of a robot have changed.
    fn taken(&mut self, robot: RobotId, taken: Taken, now: Instant) {
        self.map.changed(&taken.updated.tiles);
        if taken.updated.too_much && self.draws_too_much.insert(robot) {
            self.events.add(now, Event::Robot(RobotEvent::Floods(robot)));
        }
        if let Some(dispatch) = &mut self.dispatch {
            taken.codes().for_each(|code| dispatch.event(robot, code, now));
        }
        for event in taken.events {
            self.events.add(now, Event::Reported(robot, event));
        }
        let Some(session) = self.ports.session_mut(robot) else { return };
        let is_held_up = self.unsaved.holds_up(robot);
        if let Some(record) = self.corrections.advance(session, &self.map, is_held_up, now) {
            self.map.retire(robot, record.first_epoch);
            self.unsaved.add_cure(record);
        }
    }

    /// Takes what a frame of a camera says.
    pub fn observe(&mut self, observation: &Observation) {
        let captured = observation.captured;
        for &sighting in &observation.robots {
            let Sighting { robot, pose: seen, .. } = sighting;
            let pose = self.corrections.fix(robot, captured, seen);
            self.surroundings.robot(robot, captured, pose);
            let (footprint, side) = (self.surroundings.footprint(robot), self.terms.resolution);
            // Cells that are only just under it may hold a wall beside it.
            self.map.stands(robot, captured, footprint.cells(pose, Millimetres(-side.0), side));
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

    /// Takes what a frame of a camera, captured then, shows of robots and can't be a pose.
    pub fn sighting_event(&mut self, captured: Instant, event: SightingEvent) {
        self.events.add(captured, Event::Sighting(event));
    }

    /// Sends a command to a robot.
    ///
    /// # Errors
    /// Every [`CommandError`].
    pub fn command(&mut self, robot: RobotId, command: Command) -> Result<(), CommandError> {
        self.ports.command(robot, command)
    }

    /// Lets a coordinator decide from now on where robots drive. The server sets the resolution and
    /// the first path of its settings: paths have higher numbers than in its earlier lives.
    pub fn coordinate(&mut self, settings: Settings) {
        let Terms { resolution, server_epoch, .. } = self.terms;
        let first_path = server_epoch.wrapping_shl(20);
        self.dispatch = Some(Dispatch::new(Settings { resolution, first_path, ..settings }));
    }

    /// Lets a robot explore while it has no goal, or no longer. Without a coordinator nothing
    /// happens.
    pub fn explore(&mut self, robot: RobotId, explores: bool) {
        if let Some(dispatch) = &mut self.dispatch {
            dispatch.explore(robot, explores);
        }
    }

    /// Sends a robot to a place in `map`, in metres.
    ///
    /// # Errors
    /// Every [`GoalError`]; without a coordinator, that nobody knows where the robot is.
    pub fn goal(
        &mut self,
        robot: RobotId,
        place_m: [f64; 2],
        now: Instant,
    ) -> Result<(), GoalError> {
        let dispatch = self.dispatch.as_mut().ok_or(GoalError::UnknownRobot(robot))?;
        dispatch.goal(robot, place_m, now)
    }

    /// Leaves the robots' constant errors as they are, and robots in blind ground without fixes, to
    /// compare.
    pub fn leave_errors(&mut self) {
        self.corrections.turn_off();
    }

    /// What a robot takes up; the others are told.
    pub fn set_footprint(&mut self, robot: RobotId, footprint: Footprint) {
        self.surroundings.set_footprint(robot, footprint);
    }

    /// Does what is due at `now` besides sending. Work that takes milliseconds is done one piece at
    /// a time, so that messages need not wait for all of it: then [`Server::poll_timeout`] is `now`.
    pub fn timeout(&mut self, now: Instant) {
        let waiting = self.corrections.poll_waiting();
        if let Some(session) = waiting.and_then(|robot| self.ports.session_mut(robot)) {
            self.corrections.look(session, &mut self.map, self.terms.resolution, now);
        }
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
                    // It is sent again once the robot is back.
                    log::debug!("{error}");
                }
            }
        }
        self.dispatch = Some(dispatch);
    }

    /// Brings the map and the coverage to `now`.
    pub(crate) fn age(&mut self, now: Instant) {
        self.coverage.refresh(now);
        for robot in self.map.age(now) {
            self.events.add(now, Event::Robot(RobotEvent::Disagrees(robot)));
        }
    }

    /// Writes the next frame that is due at a port into `out`, which should have
    /// [`MAX_FRAME`](ubimap_protocol::frame::MAX_FRAME) bytes. Returns its length. The map and the
    /// coverage are brought to `now` before.
    #[must_use]
    pub fn poll_transmit(&mut self, port: usize, now: Instant, out: &mut [u8]) -> Option<usize> {
        self.age(now);
        let Self { terms, ports, map, coverage, surroundings, .. } = self;
        let epoch = Epoch(terms.server_epoch);
        let (fused, coverage) = (map.fused(), coverage.served());
        let snapshot = Snapshot { epoch, fused, coverage, surroundings };
        ports.get_mut(port).ok()?.poll_transmit(&snapshot, now, out)
    }

    /// The next thing to tell whoever runs the server, and when it happened. If nobody asks, only
    /// the newest thousand are kept.
    #[must_use]
    pub fn poll_event(&mut self) -> Option<(Instant, Event)> {
        self.events.poll()
    }

    /// When to come back at the latest to call [`Server::timeout`], and [`Server::poll_transmit`] for
    /// a port.
    pub fn poll_timeout(&self, port: usize, now: Instant) -> Option<Instant> {
        let port = self.ports.get(port).ok()?.poll_timeout(&self.snapshot(), now);
        port.into_iter().chain(self.poll_common_timeout(now)).min()
    }

    /// The same for all ports.
    pub(crate) fn poll_any_timeout(&self, now: Instant) -> Option<Instant> {
        let snapshot = self.snapshot();
        let ports = self.ports.iter().filter_map(|port| port.poll_timeout(&snapshot, now));
        ports.chain(self.poll_common_timeout(now)).min()
    }

    /// The same for what concerns no single port.
    fn poll_common_timeout(&self, now: Instant) -> Option<Instant> {
        let dispatch = self.dispatch.as_ref().map(Dispatch::poll_timeout);
        let waiting = self.corrections.has_waiting().then_some(now);
        let all = [self.coverage.poll_timeout(), self.map.poll_timeout(), dispatch, waiting];
        all.into_iter().flatten().min()
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
