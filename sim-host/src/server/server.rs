//! The server: sessions on ports, the layers of all robots, and the map that they make.

use std::collections::BTreeSet;

use ubimap_protocol::{
    link::{Counters, Terms},
    message::{DistanceVector, EventCode, Obstacle, ParameterReport, State},
    tile::{Epoch, TileId},
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};

use super::{
    alignments::Alignments,
    command::Command,
    coordinating::{Coordinating, View},
    coordination::{Coordinator, Settings},
    events::{Began, EventLog, PersonEvent, RobotEvent},
    inbox::Inbox,
    port::{Brought, Port},
    ports::{CommandError, NoSuchPort, Ports},
    scene::Scene,
    session::Session,
    shared_map::SharedMap,
    surroundings::Surroundings,
    unsaved::Unsaved,
};
use crate::{
    camera::{Observation, Sighting},
    mapping::{
        CameraTile, ConstantErrors, CoverageLayer, CureRecord, MapTime, Mask, RobotLayer,
        ServedLayer, TileRecord, Updated, Weight,
    },
    perception::{Footprint, robots::SightingEvent},
};

/// The camera server's sans-IO core. The law is the agent's: after every input call
/// [`Server::poll_transmit`] for each port until it has nothing more, then come back at
/// [`Server::poll_timeout`] and call [`Server::timeout`].
#[derive(Debug)]
pub struct Server {
    terms: Terms,
    ports: Ports,
    map: SharedMap,
    coverage: CoverageLayer,
    surroundings: Surroundings,
    sighting_events: Began<SightingEvent>,
    robot_events: Began<RobotEvent>,
    person_events: Began<PersonEvent>,
    alignments: Alignments,
    coordinating: Option<Coordinating>,
    /// Robots that draw more ground than there is.
    draws_too_much: BTreeSet<RobotId>,
    /// What the disk has not been told.
    unsaved: Unsaved,
}

impl Server {
    /// A server with so many ports and an empty map.
    pub fn new(terms: Terms, ports: usize) -> Self {
        Self {
            terms,
            ports: Ports::new(ports, terms.server_epoch),
            map: SharedMap::default(),
            coverage: CoverageLayer::default(),
            surroundings: Surroundings::default(),
            sighting_events: Began::default(),
            robot_events: Began::default(),
            person_events: Began::default(),
            alignments: Alignments::default(),
            coordinating: None,
            draws_too_much: BTreeSet::new(),
            unsaved: Unsaved::new(terms.stores),
        }
    }

    /// Takes bytes that came in at a port, in pieces of any size. What is more than any agent would
    /// send is not read: it is lost, as on a bad link.
    ///
    /// # Errors
    /// [`NoSuchPort`].
    pub fn receive(&mut self, port: usize, bytes: &[u8], now: Instant) -> Result<(), NoSuchPort> {
        let index = port;
        let port = self.ports.get_mut(index)?;
        let (mut bytes, floods) = port.admit(bytes, now);
        if let Some(robot) = port.robot().filter(|_| floods) {
            self.robot_events.add(now, RobotEvent::Floods(robot));
        }
        loop {
            let port = self.ports.get_mut(index)?;
            match port.receive(&mut bytes, now) {
                None => return Ok(()),
                Some(Brought::Nothing) => {}
                Some(Brought::Hello(hello)) => {
                    let first_epoch = self.map.next_epoch(hello.robot);
                    self.ports.greet(index, &hello, (&self.terms, first_epoch), now)?;
                }
                Some(Brought::Messages(session, messages)) => {
                    let robot = session.robot;
                    let layer = self.map.layers.entry(robot).or_default();
                    let (mut updated, mut happened) = (Updated::default(), Vec::new());
                    let mut inbox = Inbox {
                        session,
                        layer,
                        surroundings: &mut self.surroundings,
                        updated: &mut updated,
                        happened: &mut happened,
                    };
                    let (unknown, malformed) = inbox.take(messages, now);
                    self.unsaved.came(session, layer, &updated.complete);
                    port.taken(unknown, malformed);
                    self.heard(robot, &updated, happened, now);
                }
            }
        }
    }

    /// Goes on with what a robot has said.
    fn heard(&mut self, robot: RobotId, updated: &Updated, happened: Vec<EventCode>, now: Instant) {
        self.map.changed(&updated.tiles);
        if updated.too_much && self.draws_too_much.insert(robot) {
            self.robot_events.add(now, RobotEvent::Floods(robot));
        }
        if let Some(coordinating) = &mut self.coordinating {
            happened.into_iter().for_each(|code| coordinating.event(robot, code, now));
        }
        let Some(session) = self.ports.session_mut(robot) else { return };
        let holds_up = self.unsaved.holds_up(robot);
        if let Some(record) = self.alignments.go_on(session, &self.map, holds_up, now) {
            let void = self.map.layers.entry(robot).or_default().retire(record.first_epoch);
            self.map.changed(&void);
            self.unsaved.cured(record);
        }
    }

    /// Takes what a frame of a camera says.
    pub fn observe(&mut self, observation: &Observation) {
        let captured = observation.captured;
        for &sighting in &observation.robots {
            let Sighting { robot, pose: seen, .. } = sighting;
            let pose = self.alignments.fix(robot, captured, seen);
            self.surroundings.robot(robot, captured, pose);
            let (footprint, side) = (self.surroundings.footprint(robot), self.terms.resolution);
            // Cells that are only just under it may hold a wall beside it.
            self.map.stands(robot, captured, footprint.cells(pose, Millimetres(-side.0), side));
            if let Some(session) = self.ports.session_mut(robot) {
                session.fix(captured, Sighting { pose, ..sighting });
            }
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
        self.unsaved.poll_store(&self.map.layers)
    }

    /// How far the cure of a robot's constant errors has come, to be kept on disk: it does not go on
    /// before. Tiles of the robot that are void are to be deleted there.
    #[must_use]
    pub fn poll_cured(&mut self) -> Option<CureRecord> {
        self.unsaved.poll_cured()
    }

    /// Whether [`Server::poll_store`] or [`Server::poll_cured`] has something.
    pub fn has_unsaved(&self) -> bool {
        !self.unsaved.is_empty()
    }

    /// The tiles of which cameras have seen something since this was last called, to be kept on disk.
    /// Nobody waits for that: every few seconds is enough.
    #[must_use]
    pub fn take_camera_tiles(&mut self) -> Vec<CameraTile> {
        self.map.cameras.take_unkept()
    }

    /// Whether [`Server::take_camera_tiles`] has something.
    pub fn has_camera_tiles(&self) -> bool {
        self.terms.stores && self.map.cameras.has_unkept()
    }

    /// A record is on disk, for good: the robot may give the tile up.
    pub fn stored(&mut self, robot: RobotId, record: &TileRecord) {
        if let Some(layer) = self.map.layers.get_mut(&robot) {
            layer.kept(record);
        }
        if let Some(session) = self.ports.session_mut(robot) {
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

    /// Takes back what cameras had seen in an earlier life, as [`Server::restore`] does.
    pub fn restore_camera_tile(&mut self, tile: &CameraTile) {
        self.map.cameras.restore(tile);
        self.map.changed(&BTreeSet::from([tile.id]));
    }

    /// Takes back how far the cure of a robot had come in an earlier life. It goes on.
    pub fn restore_cured(&mut self, record: &CureRecord) {
        self.alignments.restore(record);
        let void = self.map.layers.entry(record.robot).or_default().retire(record.first_epoch);
        self.map.changed(&void);
    }

    /// A command for a robot.
    ///
    /// # Errors
    /// Every [`CommandError`].
    pub fn command(&mut self, robot: RobotId, command: Command) -> Result<(), CommandError> {
        self.ports.command(robot, command)
    }

    /// Lets a coordinator say from now on where robots drive. Its paths have higher numbers than
    /// those of the server's earlier lives.
    pub fn coordinate(&mut self, view_m: f64, range_m: f64, look: Duration) {
        let Terms { resolution, server_epoch, .. } = self.terms;
        let first_path = server_epoch.wrapping_shl(20);
        let settings =
            Settings { resolution, view_m, range_m, look, first_path, ..Settings::default() };
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

    /// Does what is due at `now` and has nothing to do with sending, or a piece of it that takes
    /// some milliseconds: then [`Server::poll_timeout`] is `now`, and messages need not wait for
    /// the whole.
    pub fn timeout(&mut self, now: Instant) {
        let waiting = self.alignments.poll_waiting();
        if let Some(session) = waiting.and_then(|robot| self.ports.session_mut(robot)) {
            self.alignments.look(session, &mut self.map, self.terms.resolution, now);
        }
        self.coordinate_now(now);
    }

    fn coordinate_now(&mut self, now: Instant) {
        let Some(mut coordinating) = self.coordinating.take() else { return };
        let sessions = self.ports.sessions();
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
        self.ports.session(robot)?.parameters.as_ref()
    }

    /// Writes the next frame that is due at a port into `out`, which should have
    /// [`MAX_FRAME`](ubimap_protocol::frame::MAX_FRAME) bytes. Returns its length.
    #[must_use]
    pub fn poll_transmit(&mut self, port: usize, now: Instant, out: &mut [u8]) -> Option<usize> {
        self.age(now);
        let Self { terms, ports, map, coverage, surroundings, .. } = self;
        let epoch = Epoch(terms.server_epoch);
        let scene = Scene { epoch, fused: map.fused(), coverage: coverage.served(), surroundings };
        ports.get_mut(port).ok()?.poll_transmit(&scene, now, out)
    }

    /// Brings the map and the coverage to `now`. [`Server::poll_transmit`] does that as well: a server
    /// without ports needs to be told.
    pub fn age(&mut self, now: Instant) {
        self.coverage.refresh(now);
        for robot in self.map.age(now) {
            self.robot_events.add(now, RobotEvent::Disagrees(robot));
        }
    }

    /// When to come back at the latest to call [`Server::timeout`], and [`Server::poll_transmit`] for
    /// a port.
    pub fn poll_timeout(&self, port: usize, now: Instant) -> Option<Instant> {
        let port = self.ports.get(port).ok()?.poll_timeout(&self.scene(), now);
        let coordinating = self.coordinating.as_ref().map(Coordinating::poll_timeout);
        let waiting = self.alignments.has_waiting().then_some(now);
        let all =
            [port, self.coverage.poll_timeout(), self.map.poll_timeout(), coordinating, waiting];
        all.into_iter().flatten().min()
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
        self.ports.get(port).ok()?.robot()
    }

    /// What a robot last said of itself.
    pub fn state(&self, robot: RobotId) -> Option<State> {
        self.ports.session(robot)?.state
    }

    /// The newest distance vector of a robot in its session.
    pub fn distance_vector(&self, robot: RobotId) -> Option<&DistanceVector> {
        self.ports.session(robot)?.distance_vector.as_ref()
    }

    /// How many distance vectors of a robot have come in its session.
    pub fn distance_vectors(&self, robot: RobotId) -> u32 {
        self.ports.session(robot).map_or(0, |session| session.distance_vectors)
    }

    /// What has been found of a robot's constant errors.
    pub fn errors(&self, robot: RobotId) -> Option<&ConstantErrors> {
        self.alignments.errors(robot)
    }

    /// How often a robot has asked for the time in its session.
    pub fn time_requests(&self, robot: RobotId) -> u32 {
        self.ports.session(robot).map_or(0, |session| session.time_requests)
    }

    /// Whether a robot has acknowledged the newest state of every fused tile that it wants.
    pub fn is_level(&self, robot: RobotId) -> bool {
        self.ports.session(robot).is_some_and(|session| session.is_level(&self.scene()))
    }

    /// The events that a robot has told of.
    pub fn events(&self, robot: RobotId) -> Option<&EventLog> {
        self.ports.session(robot).map(|session| &session.events)
    }

    /// Messages that wait to be sent to a robot. Tiles, peers and obstacles do not wait: of them
    /// the newest state is sent when its time has come.
    pub fn waiting(&self, robot: RobotId) -> usize {
        self.ports.session(robot).map_or(0, Session::waiting)
    }

    /// How many peers and obstacles a robot was not told of because the messages about those that
    /// are nearer left no room, counted each time.
    pub fn left_out(&self, robot: RobotId) -> u64 {
        self.ports.session(robot).map_or(0, |session| session.news.left_out())
    }

    /// Leaves the robots' constant errors as they are and tells nobody in blind ground where it is, to
    /// compare.
    pub fn leave_errors(&mut self) {
        self.alignments.leave_errors();
    }

    /// Where the robots were about a moment, as far as the cameras or they themselves have told.
    pub fn whereabouts(&self, moment: Instant) -> impl Iterator<Item = (RobotId, Pose)> {
        self.surroundings.whereabouts(moment)
    }

    /// The people and things that the cameras follow, and the moment of their positions.
    pub fn obstacles(&self) -> (Instant, Vec<Obstacle>) {
        (self.surroundings.obstacles_moment(), self.surroundings.all_obstacles())
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
        self.ports.get(port).map_or(0, Port::bytes_sent)
    }

    /// What the link of a port has counted.
    pub fn link_counters(&self, port: usize) -> Counters {
        self.ports.get(port).map_or_else(|_| Counters::default(), Port::counters)
    }

    /// Messages at a port that were of an unknown kind, and such that could not be read.
    pub fn unread_messages(&self, port: usize) -> (u32, u32) {
        self.ports.get(port).map_or((0, 0), Port::unread)
    }

    fn scene(&self) -> Scene<'_> {
        Scene {
            epoch: self.epoch(),
            fused: self.map.fused(),
            coverage: self.coverage.served(),
            surroundings: &self.surroundings,
        }
    }
}
