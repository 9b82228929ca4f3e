//! Read access to the server's state.

use ubimap_protocol::{
    frame::SessionId,
    link::Counters,
    message::{DistanceVector, Obstacle, ParameterReport, Posture, State},
    tile::{Epoch, TileId},
    time::Instant,
    units::{Pose, RobotId},
};

use super::{
    Server,
    coordination::{Errand, Unexplored},
    dispatch::Dispatch,
    event_log::EventLog,
    events::{PersonEvent, RobotEvent, Tally},
    port::{MessageCounters, Port},
    session::Session,
};
use crate::{
    mapping::{
        ConstantErrors, MapTime, Mask, Placement, PriorLayer, RobotLayer, SeenTile, ServedLayer,
        Volatility, Weight,
    },
    perception::{Footprint, robots::SightingEvent},
};

/// The map.
impl Server {
    /// The map that all robots get.
    pub fn fused(&self) -> &ServedLayer {
        self.map.fused()
    }

    /// The cells that cameras see now.
    pub fn coverage(&self) -> &ServedLayer {
        self.coverage.served()
    }

    /// A robot's layer.
    pub fn layer(&self, robot: RobotId) -> Option<&RobotLayer> {
        self.map.layer(robot)
    }

    /// What is known of where a robot was; `None` if it always was where it believed.
    pub fn placement(&self, robot: RobotId) -> Option<&Placement> {
        self.map.placement(robot)
    }

    /// How far, in metres, what a robot drew was moved at most, as the robot was not where it believed.
    pub fn farthest_moved(&self, robot: RobotId) -> f64 {
        self.map.farthest_moved(robot)
    }

    /// Whether what robots have drawn may have to move.
    pub fn is_moving(&self) -> bool {
        self.corrections.poll_follow(Instant(0)).is_some()
    }

    /// What a robot has drawn of a tile, where it belongs.
    pub fn drawn(&self, robot: RobotId, id: TileId) -> Option<&SeenTile> {
        self.map.drawn(robot, id)
    }

    /// The epoch of the server's own layers.
    pub fn epoch(&self) -> Epoch {
        Epoch(self.terms.server_epoch)
    }

    /// The time by which the map ages.
    pub fn map_time(&self) -> MapTime {
        self.map.time()
    }

    /// What is known beforehand of the cells.
    pub fn priors(&self) -> &PriorLayer {
        self.map.priors()
    }

    /// How often the cells of the fused layer have changed since the server started.
    pub fn volatility(&self) -> &Volatility {
        self.map.volatility()
    }

    /// The weight of a robot's claims.
    pub fn weight(&self, robot: RobotId) -> Weight {
        self.map.weight(robot)
    }

    /// The cells of a tile that are below robots, as cameras last saw the robots. The fused layer
    /// is not occupied there, even if other layers are.
    pub fn under(&self, id: TileId) -> Mask {
        self.map.under(id)
    }
}

/// Robots.
impl Server {
    /// The last state report in a robot's last session.
    pub fn state(&self, robot: RobotId) -> Option<State> {
        self.ports.last_session(robot)?.said().state()
    }

    /// Number of state reports in a robot's last session.
    pub fn states(&self, robot: RobotId) -> u32 {
        self.ports.last_session(robot).map_or(0, |session| session.said().states())
    }

    /// The events that a robot has reported.
    pub fn events(&self, robot: RobotId) -> Option<&EventLog> {
        self.ports.last_session(robot).map(|session| session.said().events())
    }

    /// The last parameter report with which a robot answered a user's command.
    pub fn parameters(&self, robot: RobotId) -> Option<&ParameterReport> {
        self.ports.last_session(robot)?.said().parameters()
    }

    /// The newest distance vector of a robot in its session.
    pub fn distance_vector(&self, robot: RobotId) -> Option<&DistanceVector> {
        self.ports.session(robot)?.said().vectors().0
    }

    /// Number of distance vectors received in a robot's session.
    pub fn distance_vectors(&self, robot: RobotId) -> u32 {
        self.ports.session(robot).map_or(0, |session| session.said().vectors().1)
    }

    /// The estimates of a robot's constant errors.
    pub fn errors(&self, robot: RobotId) -> Option<&ConstantErrors> {
        self.corrections.errors(robot)
    }

    /// Number of time requests in a robot's last session.
    pub fn time_requests(&self, robot: RobotId) -> u32 {
        self.ports.last_session(robot).map_or(0, |session| session.said().time_requests())
    }

    /// Whether a robot has acknowledged the newest state of every fused tile in its window.
    pub fn is_level(&self, robot: RobotId) -> bool {
        self.ports.session(robot).is_some_and(|session| session.is_level(&self.snapshot()))
    }

    /// Number of messages waiting to be sent to a robot. Tiles, peers and obstacles are not
    /// counted: only their newest state is sent when it is due.
    pub fn waiting(&self, robot: RobotId) -> usize {
        self.ports.session(robot).map_or(0, Session::waiting)
    }

    /// Number of peers and obstacles left out of messages to a robot for lack of space, summed over
    /// all messages.
    pub fn left_out(&self, robot: RobotId) -> u64 {
        self.ports.session(robot).map_or(0, Session::left_out)
    }

    /// What a robot is doing for the coordinator; `None` without one, and for a robot whose position was never
    /// known.
    pub fn errand(&self, robot: RobotId) -> Option<Errand> {
        self.dispatch.as_ref()?.errand(robot)
    }

    /// What is left to explore, if robots explore.
    pub fn unexplored(&self) -> Vec<Unexplored> {
        self.dispatch.as_ref().map(Dispatch::unexplored).unwrap_or_default()
    }

    /// Whether a robot has booted out of view, where nothing has told yet where it is.
    pub fn is_sought(&self, robot: RobotId) -> bool {
        self.corrections.is_sought(robot)
    }

    /// The newest pose of a robot, from cameras or its own reports, and its time.
    pub fn last_pose(&self, robot: RobotId) -> Option<(Instant, Pose)> {
        self.surroundings.place(robot).map(|place| (place.moment, place.pose))
    }

    /// The newest pose of each robot, from cameras or its own reports, if it is recent at `moment`.
    pub fn whereabouts(&self, moment: Instant) -> impl Iterator<Item = (RobotId, Pose)> {
        self.surroundings.whereabouts(moment)
    }
}

/// Obstacles and events.
impl Server {
    /// The robot's footprint: 40 by 40 cm unless it was set.
    pub fn footprint(&self, robot: RobotId) -> Footprint {
        self.surroundings.footprint(robot)
    }

    /// The time of the positions, and the people and things tracked by cameras.
    pub fn obstacles(&self) -> (Instant, Vec<(Obstacle, Posture)>) {
        (self.surroundings.obstacles_moment(), self.surroundings.all_obstacles())
    }

    /// Sightings of robots that can't be correct.
    pub fn sighting_events(&self) -> &Tally<SightingEvent> {
        self.events.sightings()
    }

    /// Misbehaviour of robots.
    pub fn robot_events(&self) -> &Tally<RobotEvent> {
        self.events.robots()
    }

    /// Events about people.
    pub fn person_events(&self) -> &Tally<PersonEvent> {
        self.events.people()
    }
}

/// Ports.
impl Server {
    /// The open ports in the order of opening.
    pub fn ports(&self) -> impl Iterator<Item = usize> {
        self.ports.numbers_from(0)
    }

    /// The first open port with this number or a higher one.
    pub fn port_from(&self, port: usize) -> Option<usize> {
        self.ports.numbers_from(port).next()
    }

    /// The robot with a session on a port.
    pub fn robot_at(&self, port: usize) -> Option<RobotId> {
        self.ports.get(port).ok()?.robot()
    }

    /// The session on a port.
    pub fn session_at(&self, port: usize) -> Option<SessionId> {
        self.ports.get(port).ok()?.session_id()
    }

    /// Bytes sent at a port, including framing and retransmissions.
    pub fn bytes_sent(&self, port: usize) -> u64 {
        self.ports.get(port).map_or(0, Port::bytes_sent)
    }

    /// Counters of a port's link.
    pub fn link_counters(&self, port: usize) -> Counters {
        self.ports.get(port).map_or_else(|_| Counters::default(), Port::counters)
    }

    /// Counters of the messages received at a port that had no effect.
    pub fn message_counters(&self, port: usize) -> MessageCounters {
        self.ports.get(port).map(Port::message_counters).unwrap_or_default()
    }
}
