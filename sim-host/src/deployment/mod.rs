//! Cameras, server and persistence behind one interface. The simulated room, recordings and real
//! ports all use it, each with its own clock.
//!
//! | file | content |
//! |---|---|
//! | `config` | configuration, and the state stored by earlier lives (runs of the server) |
//! | [`registry`] | the robots and their markers |
//! | `keeping` | when state is written to disk |
//! | `port` | port handles |
//! | `camera_event`, `event`, `status` | events and counters |

mod camera_event;
mod config;
mod event;
mod keeping;
mod port;
pub mod registry;
mod status;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, VecDeque};

use nalgebra::Isometry3;
use ubimap_protocol::{
    frame::{Key, MAX_FRAME},
    link::Terms,
    time::Instant,
    units::{Millimetres, RobotId},
};

use self::keeping::Keeping;
use crate::{
    camera::{Calibration, Frame, Observation, Sighting},
    perception::{
        FrameError, Observer,
        robots::{RegistryError, SightingEvent},
        steadiness::{Change, Standing},
    },
    server::{Command, CommandError, Server, coordination::GoalError},
};

pub use crate::server::Policy;
pub use camera_event::{CameraEvent, CameraEventKind};
pub use config::{Config, Kept, Life};
pub use event::Event;
pub use keeping::Batch;
pub use port::{PortClosed, PortId};
pub use status::{CameraStatus, PortStatus, Status};

/// Maximum number of events waiting to be polled; beyond it the oldest is dropped.
const MAX_EVENTS: usize = 1_000;

/// Joins perception, the server and persistence. It owns no clock, port, camera or file.
///
/// - Inputs: frames ([`frame`](Self::frame)), observations computed elsewhere, such as in a thread
///   per camera ([`observe`](Self::observe)), bytes from ports ([`receive`](Self::receive)), and
///   commands ([`command`](Self::command), [`goal`](Self::goal), [`explore`](Self::explore)).
/// - Outputs: records to store ([`poll_store`](Self::poll_store)), bytes for ports
///   ([`poll_transmit`](Self::poll_transmit)) and events ([`poll_event`](Self::poll_event)).
///
/// It follows the driving rule of this [crate]: after every input drain the three outputs, then
/// return at [`poll_timeout`](Self::poll_timeout), call [`timeout`](Self::timeout) and drain again.
/// Drain the records first: tiles that are on disk are acknowledged in the frames that follow.
/// Return a batch with [`stored`](Self::stored) once it is written, or with
/// [`store_failed`](Self::store_failed) if it could not be: nothing in it is acknowledged, it is
/// handed out again after a second, and everything else continues.
///
/// All times passed in and out are by the caller's clock, which must be monotonic and should start
/// near zero. The server's clock, which robots follow, continues across lives:
/// [`server_time`](Self::server_time) and [`since_began`](Self::since_began) convert.
///
/// ```
/// use ubimap_protocol::{
///     frame::MAX_FRAME,
///     tile::Cell,
///     time::{Duration, Instant},
///     units::{Millimetres, Pose, RobotId},
/// };
/// use ubimap_sim_host::{
///     camera::{Observation, Sighting},
///     deployment::{Config, Deployment, Life, Policy},
/// };
///
/// let mut deployment = Deployment::new(Config::new(Millimetres(50)), Life::default())?;
/// let port = deployment.open_port(Policy::Open);
/// let mut sent = 0;
///
/// // For a second a camera sees a robot, the floor, and a wall 2 m to the east, in ten frames.
/// let code = |x| if x == 40 { Cell::Occupied } else { Cell::Free };
/// let cells: Vec<_> = (30..=40).flat_map(|x| (0..20).map(move |y| ((x, y), code(x)))).collect();
/// let mut now = Instant(0);
/// for tenth in 0..10 {
///     let frame = Instant(0) + Duration::from_millis(100 * tenth);
///     // First do everything that is due before the frame.
///     while let Some(due) = deployment.poll_timeout(now).filter(|due| *due < frame) {
///         now = now.max(due);
///         deployment.timeout(now);
///         sent += drain(&mut deployment, now);
///     }
///     now = frame;
///     let robot = Sighting::usual(RobotId(1), Pose::from_metres(0.5, 0.5, 0.0));
///     deployment.observe(Observation {
///         captured: frame,
///         robots: vec![robot],
///         cells: cells.clone(),
///         ..Observation::default()
///     });
///     // Bytes that are not a frame arrive at the port.
///     deployment.receive(port, &[1, 2, 3, 0], now)?;
///     sent += drain(&mut deployment, now);
/// }
///
/// let occupied = deployment.server().fused().tiles().map(|(.., tile)| tile.counts().2);
/// assert_eq!(occupied.sum::<u32>(), 20);
/// assert_eq!(deployment.server().whereabouts(now).count(), 1);
/// assert!(sent > 0, "the sender is notified that it has no session");
///
/// /// Drains the outputs. Returns the bytes sent.
/// fn drain(deployment: &mut Deployment, now: Instant) -> usize {
///     while let Some(batch) = deployment.poll_store(now) {
///         deployment.stored(batch); // once it is on disk
///     }
///     let (mut frame, mut sent) = ([0; MAX_FRAME], 0);
///     while let Some((_port, len)) = deployment.poll_transmit(now, &mut frame) {
///         sent += len; // frame[..len] goes out at the port
///     }
///     while let Some((moment, event)) = deployment.poll_event() {
///         println!("{moment:?}: {event}");
///     }
///     sent
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Deployment {
    server: Server,
    observer: Observer,
    resolution: Millimetres,
    keeping: Keeping,
    /// The time of the server's clock when the caller's clock is zero.
    began: Instant,
    /// The port from which the search for the next frame starts.
    next_port: usize,
    cameras: BTreeMap<usize, CameraStatus>,
    /// The cameras at the poses that are known.
    calibrations: Vec<Calibration>,
    camera_events: VecDeque<(Instant, CameraEvent)>,
    events: VecDeque<(Instant, Event)>,
    sightings: Option<Vec<(Instant, Sighting)>>,
}

impl Deployment {
    /// Creates a deployment without ports. If earlier lives have stored state, the server and its
    /// clock continue from it. Memory: 40 bytes per depth pixel of each camera.
    ///
    /// # Errors
    /// Every [`RegistryError`]: the robots' markers can't be told apart.
    pub fn new(config: Config, life: Life) -> Result<Self, RegistryError> {
        let survey = config.registry.survey(config.resolution, config.obstacle_heights);
        let observer = config.registry.observer(&config.cameras, survey)?;
        let began = life.begins();
        Ok(Self {
            server: server(&config, life),
            observer,
            resolution: config.resolution,
            keeping: Keeping::new(began),
            began,
            next_port: 0,
            cameras: BTreeMap::new(),
            calibrations: config.cameras,
            camera_events: VecDeque::new(),
            events: VecDeque::new(),
            sightings: config.keeps_sightings.then(Vec::new),
        })
    }
}

/// Inputs.
impl Deployment {
    /// Opens a port, with at most one robot behind it.
    pub fn open_port(&mut self, policy: Policy) -> PortId {
        PortId(self.server.open_port(policy))
    }

    /// Gives a robot a key for keyed ports. If it had another one, its session there ends.
    pub fn set_key(&mut self, robot: RobotId, key: Key) {
        self.server.set_key(robot, key);
    }

    /// Takes a robot's key away; its session on a keyed port ends. Returns whether there was one.
    pub fn retire_key(&mut self, robot: RobotId) -> bool {
        self.server.retire_key(robot)
    }

    /// Closes a port. Ends the session of the robot there; the robot's next session, on any port,
    /// continues from the same map state.
    ///
    /// # Errors
    /// [`PortClosed`].
    pub fn close_port(&mut self, port: PortId) -> Result<(), PortClosed> {
        self.server.close_port(port.0).map_err(|_| PortClosed(port))
    }

    /// Processes bytes received at a port, in pieces of any size. Bytes beyond the maximum rate of
    /// a robot are dropped, as on a bad link.
    ///
    /// # Errors
    /// [`PortClosed`].
    pub fn receive(&mut self, port: PortId, bytes: &[u8], now: Instant) -> Result<(), PortClosed> {
        let now = self.server_time(now);
        self.server.receive(port.0, bytes, now).map_err(|_| PortClosed(port))
    }

    /// Processes a frame of one of the configured cameras. Cost: up to some 10 ms.
    pub fn frame(&mut self, mut frame: Frame, now: Instant) {
        let now = self.server_time(now);
        frame.captured = self.server_time(frame.captured);
        let told = self.server.whereabouts(frame.captured);
        let (observation, fault) = self.observer.observe(&frame, now, told);
        if let Some(fault) = fault {
            self.add_event(now, Event::Frame(fault));
        }
        while let Some((captured, camera, change)) = self.observer.poll_change() {
            self.moved(captured, camera, &change);
        }
        while let Some((captured, event)) = self.observer.poll_event() {
            self.server.sighting_event(captured, event);
        }
        self.take(observation);
    }

    /// Processes an observation that was computed elsewhere.
    pub fn observe(&mut self, mut observation: Observation) {
        observation.captured = self.server_time(observation.captured);
        self.take(observation);
    }

    /// Reports a problem with markers that was found together with an observation computed elsewhere.
    pub fn sighting_event(&mut self, captured: Instant, event: SightingEvent) {
        let captured = self.server_time(captured);
        self.server.sighting_event(captured, event);
    }

    /// Reports a camera whose frames are faulty, found while an observation was computed elsewhere.
    pub fn frame_error(&mut self, fault: FrameError, now: Instant) {
        let now = self.server_time(now);
        self.add_event(now, Event::Frame(fault));
    }

    /// Processes an observation whose times are by the server's clock.
    fn take(&mut self, mut observation: Observation) {
        self.server.observe(&observation);
        let captured = observation.captured;
        observation.captured = self.since_began(captured);
        self.cameras.entry(observation.camera).or_default().add(&observation);
        if let Some(sightings) = &mut self.sightings {
            sightings.extend(observation.robots.iter().map(|&it| (observation.captured, it)));
        }
        self.add_event(captured, Event::Observed(observation));
    }

    /// A camera has moved: what it has seen since goes, and its new pose counts.
    fn moved(&mut self, captured: Instant, camera: usize, change: &Change) {
        let known = self.calibrations.get(camera);
        let before = known.and_then(|it| it.pose().copied());
        self.tell_moved(captured, camera, change, before.as_ref());
        let known = self.calibrations.get_mut(camera);
        if let (Some(known), Some((_, calibration))) = (known, self.observer.standing(camera)) {
            *known = *calibration;
        }
    }

    /// Reports a camera that has moved, found while its observations were computed elsewhere. `before` is
    /// its last known pose.
    pub fn camera_moved(
        &mut self,
        captured: Instant,
        camera: usize,
        change: Change,
        before: Option<&Isometry3<f64>>,
    ) {
        let change = match change {
            Change::Knocked { since, pose } => {
                Change::Knocked { since: self.server_time(since), pose }
            }
            settled => settled,
        };
        let captured = self.server_time(captured);
        self.tell_moved(captured, camera, &change, before);
    }

    fn tell_moved(
        &mut self,
        captured: Instant,
        camera: usize,
        change: &Change,
        before: Option<&Isometry3<f64>>,
    ) {
        if let Change::Knocked { since, .. } = change {
            self.server.forget_camera(camera, *since);
        }
        let event = CameraEvent::new(camera, change, before);
        if self.camera_events.len() >= MAX_EVENTS {
            self.camera_events.pop_front();
        }
        self.camera_events.push_back((self.since_began(captured), event));
        self.add_event(captured, Event::Camera(event));
    }

    fn add_event(&mut self, moment: Instant, event: Event) {
        if self.events.len() >= MAX_EVENTS {
            self.events.pop_front();
        }
        self.events.push_back((moment, event));
    }

    /// Sends a command to a robot.
    ///
    /// # Errors
    /// Every [`CommandError`].
    pub fn command(&mut self, robot: RobotId, command: Command) -> Result<(), CommandError> {
        self.server.command(robot, command)
    }

    /// Sends a robot to a position in `map`, in metres, if there is a coordinator.
    ///
    /// # Errors
    /// Every [`GoalError`].
    pub fn goal(
        &mut self,
        robot: RobotId,
        place_m: [f64; 2],
        now: Instant,
    ) -> Result<(), GoalError> {
        let now = self.server_time(now);
        self.server.goal(robot, place_m, now)
    }

    /// Lets a robot explore while it has no goal, or stops it from exploring. No effect without a
    /// coordinator.
    pub fn explore(&mut self, robot: RobotId, explores: bool) {
        self.server.explore(robot, explores);
    }

    /// Tells every robot with a session to stop. A robot stays stopped until it has a session with
    /// the next life of the server.
    pub fn stop_robots(&mut self) {
        self.server.stop_robots();
    }

    /// Does all work that is due at `now`, except for output.
    pub fn timeout(&mut self, now: Instant) {
        let now = self.server_time(now);
        self.server.timeout(now);
    }
}

/// Outputs.
impl Deployment {
    /// Returns the next batch of records to write, if one is due. Always `None` without a store.
    #[must_use]
    pub fn poll_store(&mut self, now: Instant) -> Option<Batch> {
        let now = self.server_time(now);
        self.keeping.poll(&mut self.server, now)
    }

    /// Makes all records that are not on disk due now. Call it before the server ends.
    pub fn hasten_store(&mut self, now: Instant) {
        let now = self.server_time(now);
        self.keeping.hasten(now);
    }

    /// Call this once the batch is durably on disk.
    pub fn stored(&mut self, batch: Batch) {
        self.keeping.stored(&mut self.server, &batch);
    }

    /// Call this if the batch could not be written completely. [`Deployment::poll_store`] hands it
    /// out again.
    pub fn store_failed(&mut self, batch: Batch, now: Instant) {
        let now = self.server_time(now);
        self.keeping.failed(&mut self.server, &batch, now);
    }

    /// Writes the next due frame of any port into `out`, which should have [`MAX_FRAME`] bytes.
    /// Returns the port and the frame's length.
    #[must_use]
    pub fn poll_transmit(&mut self, now: Instant, out: &mut [u8]) -> Option<(PortId, usize)> {
        let now = self.server_time(now);
        // The map must age even if there is no port.
        self.server.age(now);
        while let Some(port) = self.server.port_from(self.next_port) {
            self.next_port = port;
            if let Some(len) = self.server.poll_transmit(port, now, out) {
                return Some((PortId(port), len));
            }
            self.next_port += 1;
        }
        self.next_port = 0;
        None
    }

    /// Returns the oldest event and its time. Only the newest 1,000 are kept.
    #[must_use]
    pub fn poll_event(&mut self) -> Option<(Instant, Event)> {
        let of_server = || self.server.poll_event().map(|(at, event)| (at, Event::Server(event)));
        let (moment, event) = self.events.pop_front().or_else(of_server)?;
        Some((self.since_began(moment), event))
    }

    /// The deadline for the next call of [`Deployment::timeout`].
    #[must_use]
    pub fn poll_timeout(&self, now: Instant) -> Option<Instant> {
        let now = self.server_time(now);
        let due = [self.server.poll_any_timeout(now), self.keeping.poll_timeout(&self.server)];
        due.into_iter().flatten().min().map(|due| self.since_began(due))
    }
}

/// Queries.
impl Deployment {
    /// The server with its map, robots and events. Its times are by the server's clock.
    pub fn server(&self) -> &Server {
        &self.server
    }

    /// The side length of the map's cells.
    pub fn resolution(&self) -> Millimetres {
        self.resolution
    }

    /// State and counters of cameras and ports.
    pub fn status(&self) -> Status {
        let ports = self.server.ports().map(|port| self.status_of(port));
        Status { cameras: self.cameras.clone(), ports: ports.collect() }
    }

    /// State and counters of one port.
    ///
    /// # Errors
    /// [`PortClosed`].
    pub fn port(&self, port: PortId) -> Result<PortStatus, PortClosed> {
        let is_open = self.server.port_from(port.0) == Some(port.0);
        if is_open { Ok(self.status_of(port.0)) } else { Err(PortClosed(port)) }
    }

    fn status_of(&self, port: usize) -> PortStatus {
        let robot = self.server.robot_at(port);
        PortStatus {
            port: PortId(port),
            robot,
            state: robot.and_then(|robot| self.server.state(robot)),
            link: self.server.link_counters(port),
            messages: self.server.message_counters(port),
            bytes_sent: self.server.bytes_sent(port),
        }
    }

    /// The cameras at the poses that are known, which differ from the configured ones after a knock or a
    /// drift, and whether each is in use.
    pub fn calibrations(&self) -> impl Iterator<Item = (&Calibration, bool)> {
        self.calibrations.iter().enumerate().map(|(camera, calibration)| {
            let standing = self.observer.standing(camera).map(|(standing, _)| standing);
            (calibration, standing.is_none_or(|it| it == Standing::Steady))
        })
    }

    /// The movements of cameras that were noticed, oldest first. Only the newest 1,000 are kept.
    pub fn camera_events(&self) -> impl Iterator<Item = &(Instant, CameraEvent)> {
        self.camera_events.iter()
    }

    /// Every camera sighting of a robot with its capture time, in order of arrival. Empty unless
    /// [`Config::keeps_sightings`] is set.
    pub fn sightings(&self) -> &[(Instant, Sighting)] {
        self.sightings.as_deref().unwrap_or_default()
    }

    /// Whether state that must not be lost is not on disk yet.
    pub fn has_unsaved(&self) -> bool {
        self.keeping.has_unsaved(&self.server)
    }

    /// Converts a time of the caller's clock to the server's.
    pub fn server_time(&self, moment: Instant) -> Instant {
        self.began + moment.since(Instant(0))
    }

    /// Converts a time of the server's clock to the caller's. Returns zero for times in earlier
    /// lives.
    pub fn since_began(&self, moment: Instant) -> Instant {
        Instant(0) + moment.since(self.began)
    }
}

/// Creates the server from a configuration and the state of earlier lives.
fn server(config: &Config, life: Life) -> Server {
    let terms = Terms {
        resolution: config.resolution,
        frame: MAX_FRAME as u16,
        server_epoch: life.epoch.0,
        stores: life.kept.is_some(),
    };
    let mut server = Server::new(terms, 0);
    if let Some(first) = life.first_session {
        server.number_sessions_from(first);
    }
    if let Some(salt) = life.salt {
        server.salt_from(salt);
    }
    server.expect(&config.labels);
    for (robot, footprint) in config.registry.footprints() {
        server.set_footprint(robot, footprint);
    }
    if let Some(settings) = config.coordination {
        server.coordinate(settings);
    }
    if let Some(floor) = &config.floor {
        server.keep_to(floor.clone());
    }
    if !config.corrects_errors {
        server.leave_errors();
    }
    if let Some(kept) = life.kept {
        kept.tiles.iter().for_each(|(robot, record)| server.restore(*robot, record));
        for &(robot, id, epoch) in &kept.damaged_tiles {
            server.restore_damaged(robot, id, epoch);
        }
        kept.camera_tiles.iter().for_each(|tile| server.restore_camera_tile(tile));
        kept.cures.iter().for_each(|record| server.restore_cured(record));
        kept.placements
            .iter()
            .for_each(|(robot, placement)| server.restore_placement(*robot, placement));
    }
    server
}
