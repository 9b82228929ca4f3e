//! `ubimap serve`: the camera server on serial ports, in real time.
//!
//! Drives a deployment by the wall clock. Without real cameras it serves robots on a bench: each stands
//! at a given pose, and gets fixes of it at a camera's rate.

use std::time;

use ubimap_protocol::{
    frame::MAX_FRAME,
    link::Counters,
    message::{Event, State},
    tile::Epoch,
    time::{Duration, Instant},
    units::{Millimetres, Pose, RobotId},
};

use super::{
    RunError,
    keeper::{self, Keeper},
    options::ServeOptions,
};
use crate::{
    camera::{Observation, Sighting},
    channel::serial::{SerialError, SerialPort},
    deployment::{Config, Deployment, Life, PortId, PortStatus},
    report::{EventSummary, PortSummary, ServeReport, StateSummary},
    server::{self, EventLog},
    store::StoreError,
};

/// Frame interval of the simulated camera of the bench: 15 Hz.
pub const CAPTURE_INTERVAL: Duration = Duration::from_micros(66_667);

/// Maximum wait for a byte, shared by all ports. Bytes that arrive at another port meanwhile get a
/// time that is late by up to this.
const LONGEST_WAIT: Duration = Duration::from_millis(4);
/// Minimum wait, so that the processor can idle.
const SHORTEST_WAIT: Duration = Duration::from_millis(1);

/// Serves until the time is up or every port has hung up.
pub fn run(options: &ServeOptions) -> Result<ServeReport, RunError> {
    let ports = open(options)?;
    let resolution = options.resolution;
    let (keeper, life) = keeper::open(options.store.as_deref(), resolution, epoch()?)?;
    let mut station = Station::new(resolution, life, ports, keeper)?;
    let end = options.duration.map(|duration| station.now() + duration);
    while station.is_attached() && end.is_none_or(|end| station.now() < end) {
        station.turn()?;
    }
    Ok(station.report())
}

fn open(options: &ServeOptions) -> Result<Vec<Attached>, RunError> {
    let pose = |index: usize| match options.pose[..] {
        [] => None,
        [one] => Some(one),
        _ => options.pose.get(index).copied(),
    };
    let (poses, ports) = (options.pose.len(), options.ports.len());
    if poses > 1 && poses != ports {
        return Err(RunError::Poses { poses, ports });
    }
    let attached = options.ports.iter().enumerate().map(|(index, path)| {
        let port = SerialPort::open(path, options.baud)?;
        log::info!("port {index} is {}", path.display());
        Ok(Attached::new(path.display().to_string(), Box::new(port), pose(index)))
    });
    attached.collect()
}

/// A random epoch, so that no two lives of the server share one, whatever the clock says.
fn epoch() -> Result<Epoch, RunError> {
    Ok(Epoch(getrandom::u32().map_err(RunError::Randomness)?.max(1)))
}

/// A byte stream to and from a robot, such as a serial port.
pub trait Wire {
    /// Reads the bytes that have arrived, waiting up to `wait` for the first one. Returns their number.
    fn read_within(
        &mut self,
        buffer: &mut [u8],
        wait: time::Duration,
    ) -> Result<usize, SerialError>;

    /// Queues bytes, all or none.
    fn write(&mut self, bytes: &[u8]) -> Result<(), SerialError>;
}

impl Wire for SerialPort {
    fn read_within(
        &mut self,
        buffer: &mut [u8],
        wait: time::Duration,
    ) -> Result<usize, SerialError> {
        Self::read_within(self, buffer, wait)
    }

    fn write(&mut self, bytes: &[u8]) -> Result<(), SerialError> {
        Self::write(self, bytes)
    }
}

/// A wire and the state of the robot behind it.
pub struct Attached {
    name: String,
    /// `None` once it has hung up.
    wire: Option<Box<dyn Wire>>,
    stands: Option<Pose>,
    robot: Option<RobotId>,
    /// The robot's last reported status, and its time by the server's clock.
    said: Option<(Instant, State)>,
    stalled: bool,
    bytes_up: u64,
    bytes_down: u64,
    /// The link's counters when the wire hung up.
    counted: Option<Counters>,
}

impl Attached {
    /// A wire with its name, and the pose of the robot behind it, if known.
    pub fn new(name: String, wire: Box<dyn Wire>, stands: Option<Pose>) -> Self {
        let wire = Some(wire);
        Self {
            name,
            wire,
            stands,
            robot: None,
            said: None,
            stalled: false,
            bytes_up: 0,
            bytes_down: 0,
            counted: None,
        }
    }

    /// Writes a frame. Bytes that a stalled wire does not accept are lost; the protocol resends them.
    fn write(&mut self, frame: &[u8]) {
        let Some(wire) = &mut self.wire else { return };
        match wire.write(frame) {
            Ok(()) => {
                self.stalled = false;
                self.bytes_down += frame.len() as u64;
            }
            Err(error) => self.failed(&error),
        }
    }

    /// Reads the bytes that arrive within a time. Returns their number.
    fn read_within(&mut self, buffer: &mut [u8], wait: time::Duration) -> usize {
        let Some(wire) = &mut self.wire else { return 0 };
        match wire.read_within(buffer, wait) {
            Ok(count) => {
                self.bytes_up += count as u64;
                count
            }
            Err(error) => {
                self.failed(&error);
                0
            }
        }
    }

    /// Logs the failure of a wire, and drops it if it has hung up.
    fn failed(&mut self, error: &SerialError) {
        let is_stalled = matches!(error, SerialError::Stalled { .. });
        if !(is_stalled && self.stalled) {
            log::warn!("{error}");
        }
        if !is_stalled {
            self.wire = None;
        }
        self.stalled = is_stalled;
    }

    /// Records the status of the port's robot, and logs it if it is new.
    fn note(&mut self, status: &PortStatus, now: Instant) {
        self.robot = status.robot.or(self.robot);
        if let (Some(robot), Some(state)) = (status.robot, status.state)
            && self.said.is_none_or(|(_, said)| said != state)
        {
            self.said = Some((now, state));
            log::info!("{}: robot {} is {}", self.name, robot.0, described(now, &state));
        }
    }
}

/// The simulated camera of the bench: it sees each robot with a session at its configured pose.
#[derive(Debug, Default)]
struct BenchCamera {
    next: Instant,
}

impl BenchCamera {
    /// The frame that is due. Frames late by more than one interval are skipped.
    fn poll(
        &mut self,
        now: Instant,
        robots: impl Iterator<Item = (RobotId, Pose)>,
    ) -> Option<Observation> {
        if now < self.next {
            return None;
        }
        let interval = CAPTURE_INTERVAL.micros();
        let captured = Instant(now.micros() / interval * interval);
        self.next = captured + CAPTURE_INTERVAL;
        let robots = robots.map(|(robot, pose)| Sighting::usual(robot, pose)).collect();
        Some(Observation { captured, robots, ..Observation::default() })
    }
}

/// A deployment with its wires, driven by the wall clock.
pub struct Station {
    deployment: Deployment,
    ports: Vec<(PortId, Attached)>,
    keeper: Option<Keeper>,
    camera: BenchCamera,
    started: time::Instant,
    buffer: Vec<u8>,
}

impl Station {
    /// Starts a deployment. Its records go to the keeper, if there is one.
    ///
    /// # Errors
    /// [`RunError::Registry`], which a deployment without markers does not return.
    pub fn new(
        resolution: Millimetres,
        life: Life,
        wires: Vec<Attached>,
        keeper: Option<Keeper>,
    ) -> Result<Self, RunError> {
        let mut deployment = Deployment::new(Config::new(resolution), life)?;
        let ports = wires.into_iter().map(|wire| (deployment.open_port(), wire)).collect();
        Ok(Self {
            deployment,
            ports,
            keeper,
            camera: BenchCamera::default(),
            started: time::Instant::now(),
            buffer: vec![0; 4 * MAX_FRAME],
        })
    }

    /// The deployment.
    pub fn deployment(&self) -> &Deployment {
        &self.deployment
    }

    /// The time since the station started.
    pub fn now(&self) -> Instant {
        Instant(self.started.elapsed().as_micros() as u64)
    }

    /// Whether any wire is left.
    pub fn is_attached(&self) -> bool {
        self.wired() > 0
    }

    fn wired(&self) -> u64 {
        self.ports.iter().filter(|(_, port)| port.wire.is_some()).count() as u64
    }

    /// Does the work that is due and processes input that arrives within a few milliseconds.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn turn(&mut self) -> Result<(), StoreError> {
        let now = self.now();
        let stands = self.ports.iter().filter_map(|(port, wire)| {
            Some((self.deployment.port(*port).ok()?.robot?, wire.stands?))
        });
        if let Some(observation) = self.camera.poll(now, stands) {
            self.deployment.observe(observation);
        }
        self.drain()?;
        let wait = self.wait();
        for index in 0..self.ports.len() {
            self.receive(index, wait);
            self.drain()?;
        }
        self.close_ports();
        self.deployment.timeout(self.now());
        self.drain()
    }

    /// Closes the ports of wires that have hung up.
    fn close_ports(&mut self) {
        for (port, wire) in self.ports.iter_mut().filter(|(_, wire)| wire.wire.is_none()) {
            if let Ok(status) = self.deployment.port(*port) {
                wire.counted = Some(status.link);
                // The port is open: it has a status.
                let _ = self.deployment.close_port(*port);
            }
        }
    }

    /// The time to wait at each port.
    fn wait(&self) -> time::Duration {
        let now = self.now();
        let due = self.deployment.poll_timeout(now).into_iter().chain([self.camera.next]).min();
        let until_due = due.map_or(LONGEST_WAIT, |due| due.since(now)).min(LONGEST_WAIT);
        let wait = Duration(until_due.micros() / self.wired().max(1)).max(SHORTEST_WAIT);
        time::Duration::from_micros(wait.micros())
    }

    fn receive(&mut self, index: usize, wait: time::Duration) {
        let Some((port, wire)) = self.ports.get_mut(index) else { return };
        let count = wire.read_within(&mut self.buffer, wait);
        if count == 0 {
            return;
        }
        let now = Instant(self.started.elapsed().as_micros() as u64);
        // The port is open: the wire has not hung up.
        let _ = self.deployment.receive(*port, &self.buffer[..count], now);
        if let Ok(status) = self.deployment.port(*port) {
            wire.note(&status, self.deployment.server_time(now));
        }
    }

    /// Drains the outputs.
    fn drain(&mut self) -> Result<(), StoreError> {
        let now = self.now();
        if let Some(keeper) = &mut self.keeper {
            keeper.keep(&mut self.deployment, now)?;
        }
        while let Some((port, len)) = self.deployment.poll_transmit(now, &mut self.buffer) {
            if let Some((_, wire)) = self.ports.iter_mut().find(|(id, _)| *id == port) {
                wire.write(&self.buffer[..len]);
            }
        }
        while let Some((_, event)) = self.deployment.poll_event() {
            log::log!(event.level(), "{event}");
        }
        Ok(())
    }

    /// The report on the robots at this time.
    pub fn report(&self) -> ServeReport {
        ServeReport {
            schema: ServeReport::SCHEMA,
            version: ServeReport::VERSION,
            ports: self.ports.iter().map(|(port, wire)| self.summary(*port, wire)).collect(),
            elapsed_s: self.started.elapsed().as_secs_f64(),
        }
    }

    fn summary(&self, port: PortId, wire: &Attached) -> PortSummary {
        let server = self.deployment.server();
        let status = self.deployment.port(port).ok();
        let link = status.map(|it| it.link).or(wire.counted).unwrap_or_default();
        let events = wire.robot.and_then(|robot| server.events(robot));
        PortSummary {
            port: wire.name.clone(),
            robot: wire.robot.map(|robot| robot.0),
            session: status.is_some_and(|it| it.robot.is_some()),
            hung_up: wire.wire.is_none(),
            state: wire.said.map(|(received, state)| described(received, &state)),
            events: events.map_or(0, EventLog::count),
            newest_events: events.map(summaries).unwrap_or_default(),
            time_requests: wire.robot.map_or(0, |robot| server.time_requests(robot)),
            frames_received: link.received,
            frames_bad: link.bad,
            retransmissions: link.retransmissions,
            bytes_up: wire.bytes_up,
            bytes_down: wire.bytes_down,
        }
    }
}

fn summaries(events: &EventLog) -> Vec<EventSummary> {
    let summary = |(received, event): (Instant, &Event)| EventSummary {
        received_s: seconds(received),
        what: server::described(event),
    };
    events.newest().map(summary).collect()
}

fn described(received: Instant, state: &State) -> StateSummary {
    let pose = |pose: Pose| [pose.x.metres(), pose.y.metres(), pose.heading.degrees()];
    StateSummary {
        received_s: seconds(received),
        time_s: state.time.map(seconds),
        pose: state.pose.map(pose),
        cells_refused: state.cells_refused,
    }
}

fn seconds(moment: Instant) -> f64 {
    moment.micros() as f64 / 1e6
}
