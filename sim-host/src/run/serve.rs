//! `ubimap serve`: the camera server on serial ports, in real time.
//!
//! Until real cameras come, it serves robots on a bench: each one stands where it is said to
//! stand, and gets a fix of that pose as often as a camera would send one.

use std::time::{self, SystemTime};

use ubimap_protocol::{
    frame::MAX_FRAME,
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
    report::{EventSummary, PortSummary, ServeReport, StateSummary},
    server::{self, EventLog, Server},
    store::StoreError,
};

/// Between two frames of the camera that there will be: 15 Hz.
pub const CAPTURE_INTERVAL: Duration = Duration::from_micros(66_667);

/// The longest wait for a byte, shared by all ports: what arrives at one of them meanwhile is
/// taken for that much younger than it is.
const LONGEST_WAIT: Duration = Duration::from_millis(4);
/// The shortest wait that is one.
const SHORTEST_WAIT: Duration = Duration::from_millis(1);

/// Serves until the time is over or every port has hung up.
pub fn run(options: &ServeOptions) -> Result<ServeReport, RunError> {
    let ports = open(options)?;
    let keeper = options.store.as_deref();
    let keeper = keeper.map(|path| Keeper::open(path, options.resolution, epoch())).transpose()?;
    let mut station = Station::new(options.resolution, epoch(), ports, keeper)?;
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

/// A number that grows from life to life of the server.
fn epoch() -> Epoch {
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    let seconds = since_1970.map_or(1, |since| since.as_secs());
    Epoch(seconds.clamp(1, u64::from(u32::MAX)) as u32)
}

/// What carries bytes to a robot and back without a wait for the robot: a serial port.
pub trait Wire {
    /// Reads what has arrived, waiting that long for a first byte: the number of bytes.
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

/// A wire, and what is known of the robot behind it.
pub struct Attached {
    name: String,
    /// `None` once it has hung up.
    wire: Option<Box<dyn Wire>>,
    stands: Option<Pose>,
    robot: Option<RobotId>,
    /// What the robot said last, and when.
    said: Option<(Instant, State)>,
    stalled: bool,
    bytes_up: u64,
    bytes_down: u64,
}

impl Attached {
    /// A wire by its name; the robot behind it stands at this pose, if that is known.
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
        }
    }

    /// Says what a wire that failed has to say; one that has hung up is let go.
    fn failed(&mut self, error: &SerialError) {
        match error {
            // What does not go out is lost, as on any bad link.
            SerialError::Stalled { .. } if self.stalled => {}
            SerialError::Stalled { .. } => log::warn!("{error}"),
            _ => {
                log::warn!("{error}");
                self.wire = None;
            }
        }
        self.stalled = self.wire.is_some();
    }
}

/// The server joined with its wires, on the clock of the wall.
pub struct Station {
    server: Server,
    ports: Vec<Attached>,
    keeper: Option<Keeper>,
    started: time::Instant,
    /// What the server's clock showed then.
    began: Instant,
    next_capture: Instant,
    buffer: Vec<u8>,
}

impl Station {
    /// A server that starts now; with a keeper it goes on from what is in the file. Without one
    /// its epoch is `epoch`, which should be greater than in its lives before.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn new(
        resolution: Millimetres,
        epoch: Epoch,
        ports: Vec<Attached>,
        keeper: Option<Keeper>,
    ) -> Result<Self, StoreError> {
        Ok(Self {
            server: keeper::server(keeper.as_ref(), resolution, epoch, ports.len())?,
            ports,
            began: keeper.as_ref().map_or(Instant(0), Keeper::begins),
            keeper,
            started: time::Instant::now(),
            next_capture: Instant(0),
            buffer: vec![0; 4 * MAX_FRAME],
        })
    }

    /// The server.
    pub fn server(&self) -> &Server {
        &self.server
    }

    /// The server's time.
    pub fn now(&self) -> Instant {
        self.began + Duration::from_micros(self.started.elapsed().as_micros() as u64)
    }

    /// Whether any wire is left.
    pub fn is_attached(&self) -> bool {
        self.ports.iter().any(|port| port.wire.is_some())
    }

    /// Does what is due and takes what comes, or comes within a few milliseconds.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn turn(&mut self) -> Result<(), StoreError> {
        self.capture();
        let now = self.now();
        (0..self.ports.len()).for_each(|port| self.transmit(port, now));
        let wired = self.ports.iter().filter(|port| port.wire.is_some()).count() as u64;
        let until_due = self.next_due(now).since(now).min(LONGEST_WAIT);
        let wait = Duration(until_due.micros() / wired.max(1)).max(SHORTEST_WAIT);
        for port in 0..self.ports.len() {
            self.receive(port, time::Duration::from_micros(wait.micros()));
        }
        let now = self.now();
        self.server.timeout(now);
        while let Some((_, event)) = self.server.poll_event() {
            log::log!(event.level(), "{event}");
        }
        match &mut self.keeper {
            Some(keeper) => keeper.keep(&mut self.server, now),
            None => Ok(()),
        }
    }

    /// What became of the robots so far.
    pub fn report(&self) -> ServeReport {
        ServeReport {
            schema: ServeReport::SCHEMA,
            version: ServeReport::VERSION,
            ports: (0..).zip(&self.ports).map(|(index, port)| self.summary(index, port)).collect(),
            elapsed_s: self.started.elapsed().as_secs_f64(),
        }
    }

    /// The camera's frames: a fix for each robot with a session. Frames that are late by more than
    /// one interval are left out.
    fn capture(&mut self) {
        let now = self.now();
        if now < self.next_capture {
            return;
        }
        let interval = CAPTURE_INTERVAL.micros();
        let captured = Instant(now.micros() / interval * interval);
        self.next_capture = captured + CAPTURE_INTERVAL;
        let robots = self.ports.iter().enumerate();
        let robots = robots.filter_map(|(port, it)| {
            Some(Sighting::usual(self.server.robot_at(port)?, it.stands?))
        });
        let robots = robots.collect();
        self.server.observe(&Observation { captured, robots, ..Observation::default() });
    }

    fn next_due(&self, now: Instant) -> Instant {
        let ports = self.ports.iter().enumerate().filter(|(_, port)| port.wire.is_some());
        let due = ports.filter_map(|(port, _)| self.server.poll_timeout(port, now)).min();
        due.map_or(self.next_capture, |due| due.min(self.next_capture))
    }

    fn transmit(&mut self, index: usize, now: Instant) {
        let Some(port) = self.ports.get_mut(index) else { return };
        while let Some(wire) = &mut port.wire
            && let Some(len) = self.server.poll_transmit(index, now, &mut self.buffer)
        {
            match wire.write(&self.buffer[..len]) {
                Ok(()) => {
                    port.stalled = false;
                    port.bytes_down += len as u64;
                }
                Err(error) => port.failed(&error),
            }
        }
    }

    fn receive(&mut self, index: usize, wait: time::Duration) {
        let Some(port) = self.ports.get_mut(index) else { return };
        let Some(wire) = &mut port.wire else { return };
        let count = match wire.read_within(&mut self.buffer, wait) {
            Ok(count) => count,
            Err(error) => return port.failed(&error),
        };
        if count == 0 {
            return;
        }
        port.bytes_up += count as u64;
        let now = self.began + Duration::from_micros(self.started.elapsed().as_micros() as u64);
        // There is a port of the server for each wire.
        let _ = self.server.receive(index, &self.buffer[..count], now);
        port.robot = self.server.robot_at(index).or(port.robot);
        let state = self.server.robot_at(index).and_then(|robot| self.server.state(robot));
        if let (Some(state), Some(robot)) = (state, port.robot)
            && port.said.is_none_or(|(_, said)| said != state)
        {
            port.said = Some((now, state));
            log::info!("{}: robot {} is {}", port.name, robot.0, described(now, &state));
        }
        self.transmit(index, now);
    }

    fn summary(&self, index: usize, port: &Attached) -> PortSummary {
        let counted = self.server.link_counters(index);
        let events = port.robot.and_then(|robot| self.server.events(robot));
        PortSummary {
            port: port.name.clone(),
            robot: port.robot.map(|robot| robot.0),
            session: self.server.robot_at(index).is_some(),
            hung_up: port.wire.is_none(),
            state: port.said.map(|(received, state)| described(received, &state)),
            events: events.map_or(0, EventLog::count),
            newest_events: events.map(summaries).unwrap_or_default(),
            time_requests: port.robot.map_or(0, |robot| self.server.time_requests(robot)),
            frames_received: counted.received,
            frames_bad: counted.bad,
            retransmissions: counted.retransmissions,
            bytes_up: port.bytes_up,
            bytes_down: port.bytes_down,
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
