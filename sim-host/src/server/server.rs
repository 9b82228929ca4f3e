//! The server: sessions on ports, the layers of all robots, and the map that they make.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    frame::{Direction, SessionId},
    link::{Answer, Counters, Received, Terms, answer},
    message::{
        DistanceVector, Hello, Message, ParameterReport, State, ToRobotKind, ToServerKind, Writer,
        decode,
    },
    tile::{Epoch, TileId},
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};

use super::{
    aligning::{Aligning, Answered, Looked},
    command::Command,
    coordinating::{Coordinating, View},
    coordination::{Coordinator, Settings},
    events::{Began, EventLog, PersonEvent, RobotEvent},
    inbox::Inbox,
    inflow::Inflow,
    scene::Scene,
    session::{Link, Session},
    shared_map::SharedMap,
    surroundings::Surroundings,
};
use crate::{
    camera::{Observation, Sighting},
    mapping::{
        ConstantErrors, CoverageLayer, MapTime, Mask, RobotLayer, ServedLayer, TileRecord, Updated,
        Weight,
    },
    perception::{Footprint, robots::SightingEvent},
};

/// At most this often a robot is told that it has no session here.
const RESET_INTERVAL: Duration = Duration::from_millis(200);
/// A robot states how it fares every two seconds. A session of which nothing has been heard for so
/// long (not even seven states on a bad link), where frames of something else come in, is not the one
/// that the robot has: an old hello may have opened it.
const SILENCE: Duration = Duration::from_secs(15);

/// One way in: a serial port, a simulated channel. At most one robot is behind it.
#[derive(Debug)]
struct Port {
    link: Link,
    inflow: Inflow,
    session: Option<Session>,
    /// A frame of the handshake that is due.
    answer: Option<Answer>,
    reset: Reset,
    /// Messages of unknown kinds, and such that could not be read.
    unknown: u32,
    malformed: u32,
    bytes_sent: u64,
}

#[derive(Debug, Default)]
struct Reset {
    due: bool,
    last: Option<Instant>,
}

/// The camera server's sans-IO core. The law is the agent's: after every input call
/// [`Server::poll_transmit`] for each port until it has nothing more, then come back at
/// [`Server::poll_timeout`].
#[derive(Debug)]
pub struct Server {
    terms: Terms,
    ports: Vec<Port>,
    next_session: u32,
    map: SharedMap,
    coverage: CoverageLayer,
    surroundings: Surroundings,
    sighting_events: Began<SightingEvent>,
    robot_events: Began<RobotEvent>,
    person_events: Began<PersonEvent>,
    aligning: BTreeMap<RobotId, Aligning>,
    coordinating: Option<Coordinating>,
    /// Whether constant errors are cured, and robots in blind ground told where they are.
    cures: bool,
    /// Robots that draw more ground than there is.
    draws_too_much: BTreeSet<RobotId>,
    /// Robots whose epochs below some are void, which the disk has not been told.
    retired: Vec<(RobotId, Epoch)>,
    /// Tiles of robots that have changed since they were kept on disk.
    unsaved: BTreeSet<(RobotId, TileId, Epoch)>,
}

/// A port that the server does not have.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the server has no port {0}")]
pub struct NoSuchPort(pub usize);

/// Why a command is not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CommandError {
    /// The robot has no session.
    #[error("robot {} has no session", .0.0)]
    NoSession(RobotId),
    /// It does not fit the frames that were agreed on with the robot.
    #[error("the command is too long for the frames of robot {}: shorten it", .0.0)]
    TooLong(RobotId),
}

impl Server {
    /// A server with so many ports and an empty map.
    pub fn new(terms: Terms, ports: usize) -> Self {
        let port = || Port {
            link: Link::new(Direction::ToRobot),
            inflow: Inflow::default(),
            session: None,
            answer: None,
            reset: Reset::default(),
            unknown: 0,
            malformed: 0,
            bytes_sent: 0,
        };
        Self {
            terms,
            ports: (0..ports).map(|_| port()).collect(),
            // Sessions of different lives of the server must differ.
            next_session: terms.server_epoch.wrapping_mul(0x9E37_79B9) | 1,
            map: SharedMap::default(),
            coverage: CoverageLayer::default(),
            surroundings: Surroundings::default(),
            sighting_events: Began::default(),
            robot_events: Began::default(),
            person_events: Began::default(),
            aligning: BTreeMap::new(),
            coordinating: None,
            cures: true,
            draws_too_much: BTreeSet::new(),
            retired: Vec::new(),
            unsaved: BTreeSet::new(),
        }
    }

    /// Takes bytes that came in at a port, in pieces of any size. What is more than any agent would
    /// send is not read: it is lost, as on a bad link.
    ///
    /// # Errors
    /// [`NoSuchPort`].
    pub fn receive(
        &mut self,
        port: usize,
        mut bytes: &[u8],
        now: Instant,
    ) -> Result<(), NoSuchPort> {
        let index = port;
        let port = self.ports.get_mut(index).ok_or(NoSuchPort(index))?;
        let was_flooded = port.inflow.floods();
        bytes = bytes.get(..port.inflow.admit(bytes.len(), now)).unwrap_or_default();
        if let Some(session) =
            port.session.as_ref().filter(|_| !was_flooded && port.inflow.floods())
        {
            self.robot_events.add(now, RobotEvent::Floods(session.robot));
        }
        loop {
            let port = self.ports.get_mut(index).ok_or(NoSuchPort(index))?;
            let mut updated = Updated::default();
            let mut happened = Vec::new();
            let (mut hello, mut heard) = (None, None);
            match port.link.receive(&mut bytes, now) {
                None => return Ok(()),
                Some(Received::Bad) => port.reset.due |= !port.hears(now),
                Some(Received::Handshake(message)) => {
                    hello = parse_hello(message);
                    port.malformed += u32::from(hello.is_none());
                }
                Some(Received::Session(messages)) => {
                    if let Some(session) = &mut port.session {
                        session.heard = now;
                        heard = Some(session.robot);
                        let layer = self.map.layers.entry(session.robot).or_default();
                        let (updated, surroundings) = (&mut updated, &mut self.surroundings);
                        let happened = &mut happened;
                        let mut inbox = Inbox { session, layer, surroundings, updated, happened };
                        let (unknown, malformed) = inbox.take(messages, now);
                        port.unknown += unknown;
                        port.malformed += malformed;
                        for &(id, epoch) in updated.complete.iter().filter(|_| self.terms.stores) {
                            match layer.on_disk(id, epoch) {
                                Some(stamp) => session.stored(id, stamp),
                                None => drop(self.unsaved.insert((session.robot, id, epoch))),
                            }
                        }
                    }
                }
            }
            while let Some(frame) = port.link.poll_acknowledged() {
                if let Some(session) = &mut port.session {
                    session.acknowledged(frame);
                }
            }
            if let Some(hello) = hello {
                self.greet(index, &hello, now);
            }
            self.map.changed(&updated.tiles);
            if let Some(robot) = heard {
                if updated.too_much && self.draws_too_much.insert(robot) {
                    self.robot_events.add(now, RobotEvent::Floods(robot));
                }
                if let Some(coordinating) = &mut self.coordinating {
                    happened.into_iter().for_each(|code| coordinating.event(robot, code, now));
                }
                self.align(robot, index, now);
            }
        }
    }

    /// Takes what a frame of a camera says.
    pub fn observe(&mut self, observation: &Observation) {
        let captured = observation.captured;
        for &sighting in &observation.robots {
            let Sighting { robot, pose: seen, .. } = sighting;
            let pose = self.aligning.entry(robot).or_default().fix(captured, seen);
            self.surroundings.robot(robot, captured, pose);
            let (footprint, side) = (self.surroundings.footprint(robot), self.terms.resolution);
            // Cells that are only just under it may hold a wall beside it.
            self.map.stands(robot, captured, footprint.cells(pose, Millimetres(-side.0), side));
            self.fix(captured, Sighting { pose, ..sighting });
        }
        self.coverage.observe(observation);
        let changed = self.map.cameras.observe(observation);
        self.surroundings.observe(observation, self.terms.resolution);
        while let Some(lying) = self.surroundings.poll_lying() {
            self.person_events.add(lying.moment, lying.into());
        }
        self.map.changed(&changed);
    }

    /// Takes what a frame of a camera, captured then, shows of robots and cannot be a pose.
    pub fn sighting_event(&mut self, captured: Instant, event: SightingEvent) {
        self.sighting_events.add(captured, event);
    }

    /// What the cameras saw of robots and could not be a pose.
    pub fn sighting_events(&self) -> &Began<SightingEvent> {
        &self.sighting_events
    }

    /// What has happened to people.
    pub fn person_events(&self) -> &Began<PersonEvent> {
        &self.person_events
    }

    /// What robots do and none should.
    pub fn robot_events(&self) -> &Began<RobotEvent> {
        &self.robot_events
    }

    /// A state of a robot's tile to be kept on disk, if the terms say that the server stores any.
    /// Call [`Server::stored`] when it is there.
    #[must_use]
    pub fn poll_store(&mut self) -> Option<(RobotId, TileRecord)> {
        while let Some((robot, id, epoch)) = self.unsaved.pop_first() {
            // A state of which only parts have arrived comes back when it is complete.
            if let Some(record) = self.map.layers.get(&robot).and_then(|it| it.record(id, epoch)) {
                return Some((robot, record));
            }
        }
        None
    }

    /// A robot, and an epoch: its tiles of epochs below are void, and are to be deleted where they
    /// are kept.
    #[must_use]
    pub fn poll_retired(&mut self) -> Option<(RobotId, Epoch)> {
        self.retired.pop()
    }

    /// Whether [`Server::poll_store`] or [`Server::poll_retired`] has something.
    pub fn has_unsaved(&self) -> bool {
        !self.unsaved.is_empty() || !self.retired.is_empty()
    }

    /// A record is on disk, for good: the robot may give the tile up.
    pub fn stored(&mut self, robot: RobotId, record: &TileRecord) {
        if let Some(layer) = self.map.layers.get_mut(&robot) {
            layer.kept(record);
        }
        let mut sessions = self.ports.iter_mut().filter_map(|port| port.session.as_mut());
        if let Some(session) = sessions.find(|session| session.robot == robot) {
            session.stored(record.id, record.stamp);
        }
    }

    /// Takes back a record that an earlier life of the server kept. The clock of this life must go
    /// on from that one's: the seconds in the record are of it.
    pub fn restore(&mut self, robot: RobotId, record: &TileRecord) {
        if self.map.layers.entry(robot).or_default().restore(record) {
            self.map.changed(&BTreeSet::from([record.id]));
        }
    }

    /// A command for a robot.
    ///
    /// # Errors
    /// Every [`CommandError`].
    pub fn command(&mut self, robot: RobotId, command: Command) -> Result<(), CommandError> {
        for port in &mut self.ports {
            if let Some(session) = port.session.as_mut().filter(|it| it.robot == robot) {
                let mut frame = vec![0; port.link.room()];
                if !command.write(&mut Writer::new(&mut frame)) {
                    return Err(CommandError::TooLong(robot));
                }
                session.command(command);
                return Ok(());
            }
        }
        Err(CommandError::NoSession(robot))
    }

    /// Lets a coordinator say from now on where robots drive. Its paths have higher numbers than
    /// those of the server's earlier lives. Call [`Server::timeout`] at the timeouts.
    pub fn coordinate(&mut self, view_m: f64, range_m: f64, look: Duration) {
        let Terms { resolution, server_epoch, .. } = self.terms;
        let first_path = server_epoch.wrapping_shl(20);
        let settings = Settings { resolution, view_m, range_m, look, first_path };
        self.coordinating = Some(Coordinating::new(settings));
    }

    /// Lets a robot go where nobody has been, if there is a coordinator.
    pub fn explore(&mut self, robot: RobotId) {
        if let Some(coordinating) = &mut self.coordinating {
            coordinating.explore(robot);
        }
    }

    /// What says where robots drive, if anything does: to give them goals.
    pub fn coordinator(&mut self) -> Option<&mut Coordinator> {
        self.coordinating.as_mut().map(Coordinating::coordinator)
    }

    /// Does what is due at `now` and has nothing to do with sending.
    pub fn timeout(&mut self, now: Instant) {
        let Some(mut coordinating) = self.coordinating.take() else { return };
        let sessions = self.ports.iter().filter_map(|port| port.session.as_ref());
        let heard: Vec<_> = sessions.map(|session| (session.robot, session.heard)).collect();
        let view = View {
            fused: self.map.fused(),
            coverage: self.coverage.served(),
            surroundings: &self.surroundings,
            heard: &heard,
        };
        for (robot, command) in coordinating.tick(&view, now) {
            if let Err(error) = self.command(robot, command) {
                // It is told again when it is back.
                log::debug!("{error}");
            }
        }
        self.coordinating = Some(coordinating);
    }

    /// What a robot last reported of its parameters.
    pub fn parameters(&self, robot: RobotId) -> Option<&ParameterReport> {
        self.session(robot)?.parameters.as_ref()
    }

    /// Writes the next frame that is due at a port into `out`, which should have
    /// [`MAX_FRAME`](ubimap_protocol::frame::MAX_FRAME) bytes. Returns its length.
    #[must_use]
    pub fn poll_transmit(&mut self, port: usize, now: Instant, out: &mut [u8]) -> Option<usize> {
        self.coverage.refresh(now);
        for robot in self.map.age(now) {
            self.robot_events.add(now, RobotEvent::Disagrees(robot));
        }
        let Self { terms, ports, map, coverage, surroundings, .. } = self;
        let epoch = Epoch(terms.server_epoch);
        let scene = Scene { epoch, fused: map.fused(), coverage: coverage.served(), surroundings };
        let port = ports.get_mut(port)?;
        let len = port.poll_handshake(now, out).or_else(|| {
            let Port { link, session, .. } = port;
            let session = session.as_mut()?;
            let urgent = session.is_urgent(now);
            let sent = link.poll_transmit(now, out, urgent, |writer, reliable| {
                session.fill(&scene, now, writer, reliable)
            })?;
            session.budget.spend(sent.len as u64, now);
            Some(sent.len)
        })?;
        port.bytes_sent += len as u64;
        Some(len)
    }

    /// When to come back at the latest to call [`Server::timeout`], and [`Server::poll_transmit`] for
    /// a port.
    pub fn poll_timeout(&self, port: usize, now: Instant) -> Option<Instant> {
        let port = self.ports.get(port)?;
        if port.answer.is_some() {
            return Some(now);
        }
        let reset = port.reset.due.then(|| port.reset.ready_at());
        let reliable = port.link.can_send_reliable();
        let session = port.session.as_ref();
        let scene = self.scene();
        let messages = session.and_then(|session| session.poll_timeout(&scene, reliable, now));
        let coordinating = self.coordinating.as_ref().map(Coordinating::poll_timeout);
        let layers = [self.coverage.poll_timeout(), self.map.poll_timeout(), coordinating];
        let port = [reset, port.link.poll_timeout(), messages];
        port.into_iter().chain(layers).flatten().min()
    }

    /// The map that everybody gets.
    pub fn fused(&self) -> &ServedLayer {
        self.map.fused()
    }

    /// The time by which the map ages.
    pub fn map_time(&self) -> MapTime {
        self.map.time()
    }

    /// What a robot's word counts for.
    pub fn weight(&self, robot: RobotId) -> Weight {
        self.map.weight(robot)
    }

    /// The cells of a tile that robots take up, as cameras saw them last: there the fused layer is
    /// not occupied, whatever the layers say.
    pub fn under(&self, id: TileId) -> Mask {
        self.map.under(id)
    }

    /// The cells that the cameras see now.
    pub fn coverage(&self) -> &ServedLayer {
        self.coverage.served()
    }

    /// What a robot has seen.
    pub fn layer(&self, robot: RobotId) -> Option<&RobotLayer> {
        self.map.layers.get(&robot)
    }

    /// The robot whose session is on a port.
    pub fn robot_at(&self, port: usize) -> Option<RobotId> {
        Some(self.ports.get(port)?.session.as_ref()?.robot)
    }

    /// What a robot last said of itself.
    pub fn state(&self, robot: RobotId) -> Option<State> {
        self.session(robot)?.state
    }

    /// The newest distance vector of a robot in its session.
    pub fn distance_vector(&self, robot: RobotId) -> Option<&DistanceVector> {
        self.session(robot)?.distance_vector.as_ref()
    }

    /// How many distance vectors of a robot have come in its session.
    pub fn distance_vectors(&self, robot: RobotId) -> u32 {
        self.session(robot).map_or(0, |session| session.distance_vectors)
    }

    /// What has been found of a robot's constant errors.
    pub fn errors(&self, robot: RobotId) -> Option<&ConstantErrors> {
        self.aligning.get(&robot).map(Aligning::errors)
    }

    /// How often a robot has asked for the time in its session.
    pub fn time_requests(&self, robot: RobotId) -> u32 {
        self.session(robot).map_or(0, |session| session.time_requests)
    }

    /// Whether a robot has acknowledged the newest state of every fused tile that it wants.
    pub fn is_level(&self, robot: RobotId) -> bool {
        self.session(robot).is_some_and(|session| session.is_level(&self.scene()))
    }

    /// The events that a robot has told of.
    pub fn events(&self, robot: RobotId) -> Option<&EventLog> {
        self.session(robot).map(|session| &session.events)
    }

    /// Messages that wait to be sent to a robot. Tiles, peers and obstacles do not wait: of them
    /// the newest state is sent when its time has come.
    pub fn waiting(&self, robot: RobotId) -> usize {
        self.session(robot).map_or(0, Session::waiting)
    }

    /// How many peers and obstacles a robot was not told of because the messages about those that
    /// are nearer left no room, counted each time.
    pub fn left_out(&self, robot: RobotId) -> u64 {
        self.session(robot).map_or(0, |session| session.news.left_out())
    }

    /// Leaves the robots' constant errors as they are and tells nobody in blind ground where it is, to
    /// compare.
    pub fn leave_errors(&mut self) {
        self.cures = false;
    }

    /// Where the robots were about a moment, as far as the cameras or they themselves have told.
    pub fn whereabouts(&self, moment: Instant) -> impl Iterator<Item = (RobotId, Pose)> {
        self.surroundings.whereabouts(moment)
    }

    /// What a robot takes up; the others are told.
    pub fn set_footprint(&mut self, robot: RobotId, footprint: Footprint) {
        self.surroundings.set_footprint(robot, footprint);
    }

    /// The epoch of the server's own layers.
    pub fn epoch(&self) -> Epoch {
        Epoch(self.terms.server_epoch)
    }

    /// Bytes sent at a port, framing and retransmissions included.
    pub fn bytes_sent(&self, port: usize) -> u64 {
        self.ports.get(port).map_or(0, |port| port.bytes_sent)
    }

    /// What the link of a port has counted.
    pub fn link_counters(&self, port: usize) -> Counters {
        self.ports.get(port).map_or_else(Counters::default, |port| port.link.counters())
    }

    /// Messages at a port that were of an unknown kind, and such that could not be read.
    pub fn unread_messages(&self, port: usize) -> (u32, u32) {
        self.ports.get(port).map_or((0, 0), |port| (port.unknown, port.malformed))
    }

    fn scene(&self) -> Scene<'_> {
        Scene {
            epoch: self.epoch(),
            fused: self.map.fused(),
            coverage: self.coverage.served(),
            surroundings: &self.surroundings,
        }
    }

    fn session(&self, robot: RobotId) -> Option<&Session> {
        self.ports.iter().filter_map(|port| port.session.as_ref()).find(|it| it.robot == robot)
    }

    fn fix(&mut self, moment: Instant, sighting: Sighting) {
        let mut sessions = self.ports.iter_mut().filter_map(|port| port.session.as_mut());
        if let Some(session) = sessions.find(|session| session.robot == sighting.robot) {
            session.fix(moment, sighting);
        }
    }

    /// Goes on with what a robot's distance vectors and reports are for.
    fn align(&mut self, robot: RobotId, port: usize, now: Instant) {
        let Self { aligning, ports, map, terms, .. } = self;
        let session = ports.get_mut(port).and_then(|port| port.session.as_mut());
        let Some(session) = session else { return };
        let aligning = aligning.entry(robot).or_default();
        if let Some(vector) = session.new_vector.take() {
            match aligning.looked(robot, &vector, (map, terms.resolution), now) {
                Some(Looked::Fix(fix)) if self.cures => session.matched(fix),
                Some(Looked::Fix(_)) => {}
                Some(Looked::Agreement(agree, contradict)) => {
                    map.looked(robot, agree, contradict);
                }
                None => {}
            }
        }
        let mut retired = BTreeSet::new();
        let report = session.own_report.take();
        let next = match report.and_then(|report| aligning.reported(&report, now)) {
            Some(Answered::Next(command)) => Some(command),
            Some(Answered::Retired(epoch)) => {
                retired = map.layers.entry(robot).or_default().retire(epoch);
                self.retired.extend(terms.stores.then_some((robot, epoch)));
                None
            }
            None if self.cures => {
                let next = map.layers.get(&robot).map_or(Epoch(1), RobotLayer::next_epoch);
                aligning.poll_command(next, now)
            }
            None => None,
        };
        if let Some(command) = next {
            session.command(Command::Parameter(command));
        }
        self.map.changed(&retired);
    }

    fn greet(&mut self, index: usize, hello: &Hello, now: Instant) {
        let Some(port) = self.ports.get(index) else { return };
        let known = port
            .session
            .as_ref()
            .is_some_and(|session| session.robot == hello.robot && session.nonce == hello.nonce);
        let id = if known { port.link.session() } else { SessionId(self.next_session.max(1)) };
        let first_epoch =
            self.map.layers.get(&hello.robot).map_or(Epoch(1), RobotLayer::next_epoch);
        let answered = answer(hello, &self.terms, id, first_epoch.0);
        if let (Answer::Welcome(welcome), false) = (answered, known) {
            self.next_session = self.next_session.wrapping_add(1);
            // A robot has one session: it may have moved to another port.
            let mut last = None;
            for port in &mut self.ports {
                if port.session.as_ref().is_some_and(|session| session.robot == hello.robot) {
                    last = port.session.take();
                    port.link.end();
                }
            }
            if let Some(port) = self.ports.get_mut(index) {
                port.link.begin(id, usize::from(welcome.frame));
                // A reset that was due was for what came before.
                port.reset.due = false;
                let mut session = Session::new(hello.robot, hello.nonce, hello.fused_tiles, now);
                if let Some(last) = last {
                    session.continue_from(last);
                }
                port.session = Some(session);
                log::info!("robot {} has a session on port {index}", hello.robot.0);
            }
        }
        if let Answer::Refusal(refusal) = answered {
            log::warn!("robot {} is refused: {:?}", hello.robot.0, refusal.reason);
        }
        if let Some(port) = self.ports.get_mut(index) {
            port.answer = Some(answered);
        }
    }
}

impl Port {
    /// Whether there is a session, and its robot there.
    fn hears(&self, now: Instant) -> bool {
        self.session.as_ref().is_some_and(|session| now.since(session.heard) < SILENCE)
    }

    fn poll_handshake(&mut self, now: Instant, out: &mut [u8]) -> Option<usize> {
        match self.answer.take() {
            Some(Answer::Welcome(welcome)) => {
                return self.link.handshake(ToRobotKind::Welcome as u8, &welcome, out);
            }
            Some(Answer::Refusal(refusal)) => {
                return self.link.handshake(ToRobotKind::Refusal as u8, &refusal, out);
            }
            None => {}
        }
        if !self.reset.due || self.reset.ready_at() > now {
            return None;
        }
        self.reset = Reset { due: false, last: Some(now) };
        self.link.handshake(ToRobotKind::Reset as u8, &(), out)
    }
}

impl Reset {
    fn ready_at(&self) -> Instant {
        self.last.map_or(Instant(0), |last| last + RESET_INTERVAL)
    }
}

fn parse_hello(message: Message<'_>) -> Option<Hello> {
    match ToServerKind::from_number(message.kind)? {
        ToServerKind::Hello => Some(decode(message.body).ok()?.0),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::frame::{MAX_FRAME, MIN_VERSION, VERSION};

    const TERMS: Terms =
        Terms { resolution: Millimetres(50), frame: 250, server_epoch: 1, stores: false };

    fn hello(nonce: u32) -> Vec<u8> {
        let hello = Hello {
            version: VERSION,
            min_version: MIN_VERSION,
            robot: RobotId(1),
            nonce,
            frame: 250,
            resolution: Millimetres(50),
            fused_tiles: 16,
        };
        let mut out = [0u8; 250];
        let len = Link::new(Direction::ToServer)
            .handshake(ToServerKind::Hello as u8, &hello, &mut out)
            .unwrap();
        out[..len].to_vec()
    }

    /// The frames that the server has for port 0.
    fn drain(server: &mut Server, now: Instant) -> usize {
        let mut out = [0u8; MAX_FRAME];
        std::iter::from_fn(|| server.poll_transmit(0, now, &mut out)).count()
    }

    /// An old hello must not shut the robot out whose session it has ended.
    #[test]
    fn a_session_that_only_an_old_hello_speaks_for_is_reset() {
        let mut server = Server::new(TERMS, 1);
        server.receive(0, &hello(5), Instant(0)).unwrap();
        assert_eq!(drain(&mut server, Instant(0)), 1);
        let of_the_session_before = [7u8, 7, 0];
        let soon = Instant(0) + Duration::from_secs(1);
        server.receive(0, &of_the_session_before, soon).unwrap();
        assert_eq!(drain(&mut server, soon), 0, "a frame may be damaged");
        let later = Instant(0) + SILENCE;
        server.receive(0, &of_the_session_before, later).unwrap();
        assert_eq!(drain(&mut server, later), 1);
        assert_eq!(server.robot_at(0), Some(RobotId(1)));
    }

    #[test]
    fn a_reset_that_was_due_is_forgotten_with_the_session_that_begins() {
        let mut server = Server::new(TERMS, 1);
        let garbage = [7u8, 7, 0];
        server.receive(0, &garbage, Instant(0)).unwrap();
        assert_eq!(drain(&mut server, Instant(0)), 1);
        // The next one must wait for a while, and a hello comes before.
        server.receive(0, &garbage, Instant(1)).unwrap();
        assert_eq!(drain(&mut server, Instant(1)), 0);
        server.receive(0, &hello(5), Instant(2)).unwrap();
        assert_eq!(drain(&mut server, Instant(2)), 1);
        assert_eq!(server.poll_timeout(0, Instant(2)), None);
    }
}
