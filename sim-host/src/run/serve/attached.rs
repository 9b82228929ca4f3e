//! A link to a robot: its wire, which is opened again whenever it comes back, and what is known of the
//! robot behind it.

use log::Level;
use ubimap_protocol::{
    message::State,
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::message::Message;
use crate::{
    channel::{
        intake::{Intake, Listening, SourceId},
        wire::{Wire, WireError, WireReader, WireWriter},
    },
    deployment::PortStatus,
    report::{EventSummary, LinkSummary, PortSummary, StateSummary},
    server::{self, EventLog, LoggedEvent, Server},
};

/// Interval between attempts to open a wire that has hung up.
const REOPEN_INTERVAL: Duration = Duration::from_secs(1);

/// Opens a wire, the first time and after each hang-up.
pub type Opener = Box<dyn FnMut() -> Result<Wire, WireError>>;

/// A link and the state of the robot behind it.
pub struct Attached {
    name: String,
    /// `None` for a link that a robot has opened, and opens again if it wants.
    opener: Option<Opener>,
    /// `None` while it is hung up.
    writer: Option<Box<dyn WireWriter>>,
    /// The end at which bytes arrive, until a thread listens to it.
    reader: Option<Box<dyn WireReader>>,
    /// The thread that listens. `None` for a peer of a socket, which has one for all.
    listening: Option<Listening>,
    /// When to try to open it again.
    next_attempt: Instant,
    stands: Option<Pose>,
    robot: Option<RobotId>,
    /// The robot's last reported status, and its time by the server's clock.
    said: Option<(Instant, State)>,
    is_stalled: bool,
    bytes_up: u64,
    bytes_down: u64,
    /// Counters of the links that ended with a hang-up.
    ended: LinkSummary,
}

impl Attached {
    /// Opens the wire of a port with the given name. `stands` is the pose of the robot behind it, if
    /// known.
    ///
    /// # Errors
    /// The opener's.
    pub fn open(name: String, mut opener: Opener, stands: Option<Pose>) -> Result<Self, WireError> {
        let Wire { reader, writer } = opener()?;
        let link = Self::new(name, writer, stands);
        Ok(Self { opener: Some(opener), reader: Some(reader), ..link })
    }

    /// A peer of a socket that hears all.
    pub(super) fn new(name: String, writer: Box<dyn WireWriter>, stands: Option<Pose>) -> Self {
        Self {
            name,
            opener: None,
            writer: Some(writer),
            reader: None,
            listening: None,
            next_attempt: Instant(0),
            stands,
            robot: None,
            said: None,
            is_stalled: false,
            bytes_up: 0,
            bytes_down: 0,
            ended: LinkSummary::default(),
        }
    }

    /// A connection that a robot has opened to a socket.
    pub(super) fn connected(name: String, wire: Wire, stands: Option<Pose>) -> Self {
        let Wire { reader, writer } = wire;
        Self { reader: Some(reader), ..Self::new(name, writer, stands) }
    }

    /// Starts to listen to the wire.
    ///
    /// # Errors
    /// [`WireError::Io`] if no thread can be started.
    pub(super) fn listen(&mut self, intake: &mut Intake<Message>) -> Result<(), WireError> {
        if let Some(reader) = self.reader.take() {
            self.listening = Some(intake.wire(reader)?);
        }
        Ok(())
    }

    /// The source of its arrivals, if it has one of its own.
    pub(super) fn source(&self) -> Option<SourceId> {
        self.listening.as_ref().map(Listening::source)
    }

    /// The name of the port.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// The robot that has, or last had, a session here.
    pub(super) fn robot(&self) -> Option<RobotId> {
        self.robot
    }

    /// Whether the robot, not the server, opens the link.
    pub(super) fn is_of_robot(&self) -> bool {
        self.opener.is_none()
    }

    /// Whether the wire is open.
    pub(super) fn is_open(&self) -> bool {
        self.writer.is_some()
    }

    /// The pose of the robot behind it, if known.
    pub(super) fn stands(&self) -> Option<Pose> {
        self.stands
    }

    /// Tries to open the wire again if it has hung up and an attempt is due. Returns whether it did.
    pub(super) fn reopen(&mut self, now: Instant) -> bool {
        let Some(opener) = self.opener.as_mut().filter(|_| self.writer.is_none()) else {
            return false;
        };
        if now < self.next_attempt {
            return false;
        }
        self.next_attempt = now + REOPEN_INTERVAL;
        match opener() {
            Ok(Wire { reader, writer }) => {
                log::info!("{}: connected again", self.name);
                (self.reader, self.writer) = (Some(reader), Some(writer));
            }
            Err(error) => log::debug!("{error}"),
        }
        self.is_open()
    }

    /// Writes a frame. Bytes that a stalled wire does not accept are lost; the protocol resends them.
    pub(super) fn write(&mut self, frame: &[u8]) {
        let Some(writer) = &mut self.writer else { return };
        match writer.write(frame) {
            Ok(()) => {
                self.is_stalled = false;
                self.bytes_down += frame.len() as u64;
            }
            Err(error) => self.failed(&error),
        }
    }

    /// Counts bytes that have arrived.
    pub(super) fn heard(&mut self, bytes: usize) {
        self.bytes_up += bytes as u64;
    }

    /// Logs the failure of a wire, and drops it if it has hung up.
    pub(super) fn failed(&mut self, error: &WireError) {
        let is_stalled = matches!(error, WireError::Stalled { .. });
        if !is_stalled {
            match self.is_of_robot() {
                true => log::info!("{error}"),
                false => log::warn!("{error}; waiting for it to come back"),
            }
            self.hang_up();
        } else if !self.is_stalled {
            log::warn!("{error}");
        }
        self.is_stalled = is_stalled;
    }

    /// Drops the wire.
    pub(super) fn hang_up(&mut self) {
        (self.writer, self.reader, self.listening) = (None, None, None);
    }

    /// Adds the counters of an earlier link of the same robot.
    pub(super) fn follows(&mut self, earlier: &Self) {
        self.bytes_up += earlier.bytes_up;
        self.bytes_down += earlier.bytes_down;
        self.ended = self.ended.plus(earlier.ended);
    }

    /// Records the status of the port's robot, and logs it if it is new.
    pub(super) fn note(&mut self, status: &PortStatus, now: Instant, level: Level) {
        self.robot = status.robot.or(self.robot);
        if let (Some(robot), Some(state)) = (status.robot, status.state)
            && self.said.is_none_or(|(_, said)| said != state)
        {
            self.said = Some((now, state));
            log::log!(level, "{}: robot {} is {}", self.name, robot.0, described(now, &state));
        }
    }

    /// Records the final counters of the link when its wire has hung up.
    pub(super) fn end_link(&mut self, status: &PortStatus) {
        self.ended = self.counters(Some(status));
    }

    /// Counters of all links so far: those that ended, and the one with this status.
    fn counters(&self, status: Option<&PortStatus>) -> LinkSummary {
        let current = status.map(|status| LinkSummary::new(status.link, status.messages));
        self.ended.plus(current.unwrap_or_default())
    }

    /// The report on the port. `status` is the status of its current link; `None` if none is open.
    pub(super) fn summary(&self, status: Option<&PortStatus>, server: &Server) -> PortSummary {
        let events = self.robot.and_then(|robot| server.events(robot));
        PortSummary {
            port: self.name.clone(),
            robot: self.robot.map(|robot| robot.0),
            session: status.is_some_and(|it| it.robot.is_some()),
            hung_up: !self.is_open(),
            state: self.said.map(|(received, state)| described(received, &state)),
            events: events.map_or(0, EventLog::count),
            newest_events: events.map(summaries).unwrap_or_default(),
            time_requests: self.robot.map_or(0, |robot| server.time_requests(robot)),
            link: self.counters(status),
            bytes_up: self.bytes_up,
            bytes_down: self.bytes_down,
        }
    }
}

fn summaries(events: &EventLog) -> Vec<EventSummary> {
    let summary = |it: &LoggedEvent| EventSummary {
        received_s: seconds(it.last),
        first_s: seconds(it.first),
        times: it.times,
        what: server::described(&it.event),
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
