//! What can be asked of the server.

use ubimap_protocol::{
    link::Counters,
    message::{DistanceVector, Obstacle, ParameterReport, State},
    tile::{Epoch, TileId},
    time::Instant,
    units::{Pose, RobotId},
};

use super::{
    Server,
    events::{EventLog, PersonEvent, RobotEvent, Tally},
    port::Port,
    session::Session,
};
use crate::{
    mapping::{ConstantErrors, MapTime, Mask, RobotLayer, ServedLayer, Weight},
    perception::{Footprint, robots::SightingEvent},
};

/// The map.
impl Server {
    /// The map that everybody gets.
    pub fn fused(&self) -> &ServedLayer {
        self.map.fused()
    }

    /// The cells that the cameras see now.
    pub fn coverage(&self) -> &ServedLayer {
        self.coverage.served()
    }

    /// What a robot has seen.
    pub fn layer(&self, robot: RobotId) -> Option<&RobotLayer> {
        self.map.layer(robot)
    }

    /// The epoch of the server's own layers.
    pub fn epoch(&self) -> Epoch {
        Epoch(self.terms.server_epoch)
    }

    /// The time by which the map ages.
    pub fn map_time(&self) -> MapTime {
        self.map.time()
    }

    /// How much a robot's word counts.
    pub fn weight(&self, robot: RobotId) -> Weight {
        self.map.weight(robot)
    }

    /// The cells of a tile that robots take up, as cameras saw them last: there the fused layer is
    /// not occupied, whatever the layers say.
    pub fn under(&self, id: TileId) -> Mask {
        self.map.under(id)
    }
}

/// Robots.
impl Server {
    /// What a robot last said of itself, in its last session.
    pub fn state(&self, robot: RobotId) -> Option<State> {
        self.ports.last_session(robot)?.said().state()
    }

    /// The events that a robot has reported.
    pub fn events(&self, robot: RobotId) -> Option<&EventLog> {
        self.ports.last_session(robot).map(|session| session.said().events())
    }

    /// What a robot last reported of its parameters, in answer to a user.
    pub fn parameters(&self, robot: RobotId) -> Option<&ParameterReport> {
        self.ports.last_session(robot)?.said().parameters()
    }

    /// The newest distance vector of a robot in its session.
    pub fn distance_vector(&self, robot: RobotId) -> Option<&DistanceVector> {
        self.ports.session(robot)?.said().vectors().0
    }

    /// How many distance vectors of a robot have come in its session.
    pub fn distance_vectors(&self, robot: RobotId) -> u32 {
        self.ports.session(robot).map_or(0, |session| session.said().vectors().1)
    }

    /// What has been found of a robot's constant errors.
    pub fn errors(&self, robot: RobotId) -> Option<&ConstantErrors> {
        self.corrections.errors(robot)
    }

    /// How often a robot has asked for the time in its last session.
    pub fn time_requests(&self, robot: RobotId) -> u32 {
        self.ports.last_session(robot).map_or(0, |session| session.said().time_requests())
    }

    /// Whether a robot has acknowledged the newest state of every fused tile that it wants.
    pub fn is_level(&self, robot: RobotId) -> bool {
        self.ports.session(robot).is_some_and(|session| session.is_level(&self.snapshot()))
    }

    /// Messages that wait to be sent to a robot. Tiles, peers and obstacles do not wait: only their
    /// newest state is sent, when its time has come.
    pub fn waiting(&self, robot: RobotId) -> usize {
        self.ports.session(robot).map_or(0, Session::waiting)
    }

    /// How many peers and obstacles a robot was not told of because nearer ones left no room,
    /// counted each time.
    pub fn left_out(&self, robot: RobotId) -> u64 {
        self.ports.session(robot).map_or(0, Session::left_out)
    }

    /// Where the robots were about a moment, as far as the cameras or they themselves have said.
    pub fn whereabouts(&self, moment: Instant) -> impl Iterator<Item = (RobotId, Pose)> {
        self.surroundings.whereabouts(moment)
    }
}

/// What happens.
impl Server {
    /// What a robot takes up of the floor; 40 by 40 cm unless it was set.
    pub fn footprint(&self, robot: RobotId) -> Footprint {
        self.surroundings.footprint(robot)
    }

    /// The people and things that the cameras follow, and the moment of their positions.
    pub fn obstacles(&self) -> (Instant, Vec<Obstacle>) {
        (self.surroundings.obstacles_moment(), self.surroundings.all_obstacles())
    }

    /// What the cameras saw of robots and could not be a pose.
    pub fn sighting_events(&self) -> &Tally<SightingEvent> {
        self.events.sightings()
    }

    /// What robots did and none should.
    pub fn robot_events(&self) -> &Tally<RobotEvent> {
        self.events.robots()
    }

    /// What has happened to people.
    pub fn person_events(&self) -> &Tally<PersonEvent> {
        self.events.people()
    }
}

/// Ports.
impl Server {
    /// The open ports, in the order in which they were opened.
    pub fn ports(&self) -> impl Iterator<Item = usize> {
        self.ports.numbers_from(0)
    }

    /// The first open port with this number or a higher one.
    pub fn port_from(&self, port: usize) -> Option<usize> {
        self.ports.numbers_from(port).next()
    }

    /// The robot whose session is on a port.
    pub fn robot_at(&self, port: usize) -> Option<RobotId> {
        self.ports.get(port).ok()?.robot()
    }

    /// Bytes sent at a port, framing and retransmissions included.
    pub fn bytes_sent(&self, port: usize) -> u64 {
        self.ports.get(port).map_or(0, Port::bytes_sent)
    }

    /// What the link of a port has counted.
    pub fn link_counters(&self, port: usize) -> Counters {
        self.ports.get(port).map_or_else(|_| Counters::default(), Port::counters)
    }

    /// Messages at a port that were of an unknown kind, and messages that could not be read.
    pub fn unread_messages(&self, port: usize) -> (u32, u32) {
        self.ports.get(port).map_or((0, 0), Port::unread)
    }
}
