//! A port of the bench: its wire, which is opened again whenever it comes back, and what is known
//! of the robot behind it.

use std::time;

use ubimap_protocol::{
    link::Counters,
    message::{Event, State},
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use crate::{
    channel::{serial::SerialError, wire::Wire},
    deployment::PortStatus,
    report::{EventSummary, PortSummary, StateSummary},
    server::{self, EventLog, Server},
};

/// Interval between attempts to open a wire that has hung up.
const REOPEN_INTERVAL: Duration = Duration::from_secs(1);

/// Opens a wire, the first time and after each hang-up.
pub type Opener = Box<dyn FnMut() -> Result<Box<dyn Wire>, SerialError>>;

/// A port of the bench and the state of the robot behind it.
pub struct Attached {
    name: String,
    opener: Opener,
    /// `None` while it is hung up.
    wire: Option<Box<dyn Wire>>,
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
    ended: Counters,
}

impl Attached {
    /// Opens the wire of a port with the given name. `stands` is the pose of the robot behind it, if
    /// known.
    ///
    /// # Errors
    /// The opener's.
    pub fn open(
        name: String,
        mut opener: Opener,
        stands: Option<Pose>,
    ) -> Result<Self, SerialError> {
        let wire = Some(opener()?);
        Ok(Self {
            name,
            opener,
            wire,
            next_attempt: Instant(0),
            stands,
            robot: None,
            said: None,
            is_stalled: false,
            bytes_up: 0,
            bytes_down: 0,
            ended: Counters::default(),
        })
    }

    /// Whether the wire is open.
    pub(super) fn is_open(&self) -> bool {
        self.wire.is_some()
    }

    /// The pose of the robot behind it, if known.
    pub(super) fn stands(&self) -> Option<Pose> {
        self.stands
    }

    /// Tries to open the wire again if it has hung up and an attempt is due. Returns whether it did.
    pub(super) fn reopen(&mut self, now: Instant) -> bool {
        if self.is_open() || now < self.next_attempt {
            return false;
        }
        self.next_attempt = now + REOPEN_INTERVAL;
        match (self.opener)() {
            Ok(wire) => {
                log::info!("{}: connected again", self.name);
                self.wire = Some(wire);
            }
            Err(error) => log::debug!("{error}"),
        }
        self.is_open()
    }

    /// Writes a frame. Bytes that a stalled wire does not accept are lost; the protocol resends them.
    pub(super) fn write(&mut self, frame: &[u8]) {
        let Some(wire) = &mut self.wire else { return };
        match wire.write(frame) {
            Ok(()) => {
                self.is_stalled = false;
                self.bytes_down += frame.len() as u64;
            }
            Err(error) => self.failed(&error),
        }
    }

    /// Reads the bytes that arrive within a time. Returns their number.
    pub(super) fn read_within(&mut self, buffer: &mut [u8], wait: time::Duration) -> usize {
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
        if !is_stalled {
            log::warn!("{error}; waiting for it to come back");
            self.wire = None;
        } else if !self.is_stalled {
            log::warn!("{error}");
        }
        self.is_stalled = is_stalled;
    }

    /// Records the status of the port's robot, and logs it if it is new.
    pub(super) fn note(&mut self, status: &PortStatus, now: Instant) {
        self.robot = status.robot.or(self.robot);
        if let (Some(robot), Some(state)) = (status.robot, status.state)
            && self.said.is_none_or(|(_, said)| said != state)
        {
            self.said = Some((now, state));
            log::info!("{}: robot {} is {}", self.name, robot.0, described(now, &state));
        }
    }

    /// Records the final counters of the link when its wire has hung up.
    pub(super) fn end_link(&mut self, status: &PortStatus) {
        self.ended = self.counters(Some(status));
    }

    /// Counters of all links so far: those that ended, and the one with this status.
    fn counters(&self, status: Option<&PortStatus>) -> Counters {
        let link = status.map(|status| status.link).unwrap_or_default();
        let ended = self.ended;
        Counters {
            sent: ended.sent.wrapping_add(link.sent),
            retransmissions: ended.retransmissions.wrapping_add(link.retransmissions),
            received: ended.received.wrapping_add(link.received),
            duplicates: ended.duplicates.wrapping_add(link.duplicates),
            bad: ended.bad.wrapping_add(link.bad),
            refused: ended.refused.wrapping_add(link.refused),
            replayed: ended.replayed.wrapping_add(link.replayed),
            forged: ended.forged.wrapping_add(link.forged),
        }
    }

    /// The report on the port. `status` is the status of its current link; `None` if none is open.
    pub(super) fn summary(&self, status: Option<&PortStatus>, server: &Server) -> PortSummary {
        let link = self.counters(status);
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
            frames_received: link.received,
            frames_bad: link.bad,
            retransmissions: link.retransmissions,
            bytes_up: self.bytes_up,
            bytes_down: self.bytes_down,
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
