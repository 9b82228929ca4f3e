//! Events that need attention: reported by robots, impossible sightings, misbehaving robots, people
//! lying on the floor.

use core::fmt;
use std::collections::{BTreeMap, VecDeque};

use ubimap_protocol::{
    frame::{MIN_VERSION, VERSION},
    link::FrameFault,
    message::{self, EventCode, Hello, RefusalReason, Severity},
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::{coordination::Notice, unread::Unread};
use crate::perception::{Lying, robots::SightingEvent};

/// Maximum number of events waiting to be polled; beyond it the oldest is dropped.
const MAX_WAITING: usize = 1_000;

/// Length of the interval in which events are counted.
const LIMIT_INTERVAL: Duration = Duration::from_secs(10);
/// Maximum number of events of one kind from one port in an interval.
const MAX_IN_INTERVAL: u32 = 20;

/// An event for the operator of the server.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A robot opened a session at a port.
    Joined(RobotId, usize),
    /// A robot that said this Hello was refused a session.
    Refused(Hello, RefusalReason),
    /// A frame that came to a port was dropped.
    Dropped(usize, FrameFault),
    /// A message that came to a port could not be read.
    Unread(usize, Unread),
    /// A robot reported an event.
    Reported(RobotId, message::Event),
    /// A sighting of a robot can't be a pose.
    Sighting(SightingEvent),
    /// A robot misbehaves, or its map data is in trouble.
    Robot(RobotEvent),
    /// An event about a person.
    Person(PersonEvent),
    /// Progress or the end of a robot's drive.
    Drive(RobotId, Notice),
    /// A port caused more events of a kind than the rate limit allows.
    LeftOut {
        /// The port.
        port: usize,
        /// The kind of the events.
        kind: EventKind,
        /// Number of events left out.
        events: u32,
    },
}

/// A kind of event whose rate is limited for each port, since robots can cause any number of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum EventKind {
    /// [`Event::Joined`].
    Joined,
    /// [`Event::Refused`].
    Refused,
    /// [`Event::Reported`].
    Reported,
    /// [`Event::Robot`] about limits.
    Limits,
    /// [`Event::Dropped`].
    Dropped,
    /// [`Event::Unread`].
    Unread,
}

impl fmt::Display for EventKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Joined => "new sessions",
            Self::Refused => "refused sessions",
            Self::Reported => "events reported by robots",
            Self::Limits => "limits exceeded by robots",
            Self::Dropped => "dropped frames",
            Self::Unread => "unread messages",
        })
    }
}

impl Event {
    /// The log level of the event.
    pub fn level(&self) -> log::Level {
        match self {
            Self::Joined(RobotId(0), _) => log::Level::Warn,
            Self::Joined(..) => log::Level::Info,
            Self::Reported(_, event) if is_routine(event) => log::Level::Info,
            Self::Drive(_, Notice::ShutIn) => log::Level::Warn,
            Self::Drive(..) | Self::Dropped(..) | Self::Unread(..) => log::Level::Debug,
            Self::LeftOut { kind: EventKind::Dropped | EventKind::Unread, .. } => log::Level::Debug,
            _ => log::Level::Warn,
        }
    }
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Joined(robot, port) => {
                write!(f, "robot {}{} has a session on port {port}", robot.0, about_number(*robot))
            }
            Self::Refused(hello, reason) => {
                write!(f, "robot {} {}", hello.robot.0, refused(hello, *reason))
            }
            Self::Dropped(port, fault) => write!(f, "port {port}: dropped a frame: {fault}"),
            Self::Unread(port, unread) => write!(f, "port {port}: ignored {unread}"),
            Self::Reported(robot, event) => write!(f, "robot {} {}", robot.0, reason(event)),
            Self::Sighting(event) => event.fmt(f),
            Self::Robot(event) => event.fmt(f),
            Self::Person(event) => event.fmt(f),
            Self::Drive(robot, notice) => write!(f, "robot {} {notice}", robot.0),
            Self::LeftOut { port, kind, events } => {
                write!(f, "port {port}: {events} more {kind} are left out here")
            }
        }
    }
}

/// What to do about a robot's number, as an addition to it; empty if nothing.
pub fn about_number(robot: RobotId) -> &'static str {
    match robot.0 {
        0 => {
            " (number 0: its image was not provisioned, so it moves nothing; give it a number with ubimap provision)"
        }
        _ => "",
    }
}

/// Events waiting to be polled, and tallies of recurring ones.
#[derive(Debug, Default)]
pub(super) struct Events {
    waiting: VecDeque<(Instant, Event)>,
    sightings: Tally<SightingEvent>,
    robots: Tally<RobotEvent>,
    people: Tally<PersonEvent>,
    limits: EventLimits,
}

impl Events {
    pub(super) fn add(&mut self, moment: Instant, event: Event) {
        match event {
            Event::Sighting(event) => self.sightings.add(moment, event),
            Event::Robot(event) => self.robots.add(moment, event),
            Event::Person(event) => self.people.add(moment, event),
            _ => {}
        }
        if self.waiting.len() >= MAX_WAITING {
            self.waiting.pop_front();
        }
        self.waiting.push_back((moment, event));
    }

    /// Adds an event that the robot at a port caused, unless the rate limit is exceeded.
    pub(super) fn add_from(&mut self, port: usize, moment: Instant, event: Event) {
        let kind = match event {
            Event::Joined(..) => EventKind::Joined,
            Event::Refused(..) => EventKind::Refused,
            Event::Reported(..) => EventKind::Reported,
            Event::Robot(_) => EventKind::Limits,
            Event::Dropped(..) => EventKind::Dropped,
            Event::Unread(..) => EventKind::Unread,
            _ => return self.add(moment, event),
        };
        if self.limits.admit(port, kind, moment) {
            self.add(moment, event);
        }
    }

    /// Adds an [`Event::LeftOut`] for each kind and port whose interval of ten seconds is over and
    /// exceeded the rate limit.
    pub(super) fn timeout(&mut self, now: Instant) {
        let left_out: Vec<Event> = self.limits.timeout(now).collect();
        left_out.into_iter().for_each(|event| self.add(now, event));
    }

    pub(super) fn poll(&mut self) -> Option<(Instant, Event)> {
        self.waiting.pop_front()
    }

    pub(super) fn sightings(&self) -> &Tally<SightingEvent> {
        &self.sightings
    }

    pub(super) fn robots(&self) -> &Tally<RobotEvent> {
        &self.robots
    }

    pub(super) fn people(&self) -> &Tally<PersonEvent> {
        &self.people
    }
}

/// Rate limits for the events of each kind from each port, so that no robot can fill the log.
#[derive(Debug, Default)]
pub(super) struct EventLimits {
    counts: BTreeMap<(usize, EventKind), Count>,
}

#[derive(Debug)]
struct Count {
    since: Instant,
    events: u32,
}

impl EventLimits {
    /// Counts an event. Returns whether it is within the rate limit.
    fn admit(&mut self, port: usize, kind: EventKind, now: Instant) -> bool {
        let count = self.counts.entry((port, kind)).or_insert(Count { since: now, events: 0 });
        count.events = count.events.saturating_add(1);
        count.events <= MAX_IN_INTERVAL
    }

    /// Ends the intervals that are over. Returns an [`Event::LeftOut`] for each in which events
    /// were left out.
    fn timeout(&mut self, now: Instant) -> impl Iterator<Item = Event> {
        let over =
            self.counts.extract_if(.., move |_, count| now.since(count.since) >= LIMIT_INTERVAL);
        over.filter_map(|((port, kind), count)| {
            let events = count.events.checked_sub(MAX_IN_INTERVAL).filter(|&events| events > 0)?;
            Some(Event::LeftOut { port, kind, events })
        })
    }
}

/// Misbehaviour of a robot, or trouble with its map data.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RobotEvent {
    /// Its layer or its distance vectors contradict the cameras or the other robots, and no
    /// constant error explains it.
    Disagrees(RobotId),
    /// It sends more than any agent would, or exceeds the maximum number of tiles.
    Floods(RobotId),
    /// The layers of all robots have reached their maximum memory: its new tiles are refused.
    NoRoom(RobotId),
    /// The server already knows its maximum number of robots, so this one is refused a session.
    TooMany(RobotId),
    /// This number of its tiles were damaged in the store, and it has not sent them again.
    LostTiles(RobotId, usize),
    /// It seals its frames, and there is no key for it.
    NoKey(RobotId),
    /// It has no session, and its sealed Hello is older than its last one.
    OldAttempt(RobotId),
}

impl fmt::Display for RobotEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Disagrees(robot) => {
                write!(
                    f,
                    "robot {} contradicts the cameras or the other robots; its map data gets less weight",
                    robot.0
                )
            }
            Self::Floods(robot) => {
                write!(
                    f,
                    "robot {} exceeds its limit of data or tiles; the excess is dropped",
                    robot.0
                )
            }
            Self::NoRoom(robot) => {
                write!(
                    f,
                    "robot {} draws more than the server has memory for: the tiles of all robots take 64 MiB; its new tiles are not kept or stored until the server starts with a new --store",
                    robot.0
                )
            }
            Self::TooMany(robot) => {
                write!(
                    f,
                    "robot {} gets no session: the server knows 1,024 robots, its maximum; start it with a new --store to forget them",
                    robot.0
                )
            }
            Self::NoKey(robot) => {
                let robot = robot.0;
                write!(
                    f,
                    "robot {robot} is sealed, and there is no key for it here: ubimap keys make {robot}"
                )
            }
            Self::OldAttempt(robot) => {
                write!(
                    f,
                    "robot {} says hello with an older stamp than its last one: a replay, or its boot counter was reset; give it a new key",
                    robot.0
                )
            }
            Self::LostTiles(robot, tiles) => {
                write!(
                    f,
                    "robot {} has not sent again {tiles} of its tiles that were damaged in the store: what it drew there is lost, until a robot draws it again",
                    robot.0
                )
            }
        }
    }
}

/// An event about a person that needs attention.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum PersonEvent {
    /// A person lies on the floor at this position in `map`.
    Lies {
        /// Position along x.
        x: Millimetres,
        /// Position along y.
        y: Millimetres,
    },
}

impl From<Lying> for PersonEvent {
    fn from(lying: Lying) -> Self {
        let [x, y] = lying.position_m.map(Millimetres::from_metres);
        Self::Lies { x, y }
    }
}

impl fmt::Display for PersonEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self::Lies { x, y } = self;
        write!(f, "a person lies on the floor at ({:.1}, {:.1}) m", x.metres(), y.metres())
    }
}

/// For each event, how often it has begun, and when it last began.
#[derive(Clone, Debug)]
pub struct Tally<E> {
    events: BTreeMap<E, (u64, Instant)>,
}

impl<E> Default for Tally<E> {
    fn default() -> Self {
        Self { events: BTreeMap::new() }
    }
}

impl<E: Copy + Ord> Tally<E> {
    fn add(&mut self, moment: Instant, event: E) {
        let (count, last) = self.events.entry(event).or_insert((0, moment));
        *count += 1;
        *last = moment.max(*last);
    }

    /// Each event with the number of times it began, and the time of the last one.
    pub fn iter(&self) -> impl Iterator<Item = (E, u64, Instant)> {
        self.events.iter().map(|(&event, &(count, last))| (event, count, last))
    }
}

/// Escapes all unprintable characters of a text from a robot: control characters could write lines
/// and commands to a terminal, and bidirectional ones could reorder a line.
fn escaped(text: &str) -> String {
    let mut escaped = String::new();
    for letter in text.chars() {
        if matches!(letter, '"' | '\'') {
            escaped.push(letter);
        } else {
            escaped.extend(letter.escape_debug());
        }
    }
    escaped
}

/// Formats an event with its severity, such as "Warning: ran out of tiles and refused cells".
pub fn described(event: &message::Event) -> String {
    let severity = match event.severity {
        Severity::Info => "Info",
        Severity::Warning => "Warning",
        Severity::Error => "Error",
    };
    format!("{severity}: {}", reason(event))
}

/// Whether an event is part of normal operation: the robot or the server handles it, and the
/// operator has nothing to do.
pub(super) fn is_routine(event: &message::Event) -> bool {
    use EventCode::{PathBlocked, PathDone, PoseFound, PoseLost, Started, StoppedByPerson};
    let routine = [Started, PoseLost, PoseFound, StoppedByPerson, PathBlocked, PathDone];
    event.severity == Severity::Info
        || EventCode::from_number(event.code).is_some_and(|code| routine.contains(&code))
}

/// What a refused robot offered and what is required, as the end of a sentence that begins with the
/// robot.
fn refused(hello: &Hello, reason: RefusalReason) -> String {
    match reason {
        RefusalReason::Version { .. } => format!(
            "is refused: it speaks protocol versions {} to {}; this server speaks {MIN_VERSION} to {VERSION}",
            hello.min_version, hello.version
        ),
        RefusalReason::Resolution(side) => format!(
            "is refused: it offers cells of {} mm; this map has {} mm",
            hello.resolution.0, side.0
        ),
        RefusalReason::Frame(least) => format!(
            "is refused: it can receive frames of {} bytes; the minimum is {least}",
            hello.frame
        ),
        reason => format!("is refused: {reason}"),
    }
}

/// What a robot reports, as the end of a sentence that begins with the robot.
fn reason(event: &message::Event) -> String {
    let what = match EventCode::from_number(event.code) {
        Some(EventCode::Started) => "has started",
        Some(EventCode::PoseLost) => "has no pose",
        Some(EventCode::PoseFound) => "has a pose again",
        Some(EventCode::SensorFault) => "gets no valid scans from its sensor",
        Some(EventCode::DriveFault) => "has a fault in its drive",
        Some(EventCode::PoolFull) => "ran out of tiles and refused cells",
        Some(EventCode::LowBattery) => "has a low battery",
        Some(EventCode::Collision) => "has run into something",
        Some(EventCode::StoppedByPerson) => {
            "has stopped for somebody or something that is not on its map"
        }
        Some(EventCode::PathBlocked) => "can't go on: its path is blocked",
        Some(EventCode::PathDone) => "is at the end of its path",
        Some(EventCode::Watchdog) => "was restarted by its watchdog",
        Some(EventCode::ScanOverflow) => "dropped a scan: too many wait for a pose",
        Some(EventCode::ClockBackwards) => "has a sensor whose clock ran backwards",
        Some(EventCode::FixRejected) => "rejected a fix that contradicts its odometry",
        None => {
            let detail = escaped(event.detail.as_str());
            return format!("reports event {} {detail}", event.code).trim_end().into();
        }
    };
    let detail = escaped(event.detail.as_str());
    if detail.is_empty() { what.to_owned() } else { format!("{what} ({detail})") }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    fn level(code: EventCode) -> log::Level {
        Event::Reported(RobotId(1), event(code, "")).level()
    }

    #[test]
    fn a_robot_that_waits_for_a_pose_or_a_person_is_no_warning() {
        for code in [EventCode::PoseLost, EventCode::StoppedByPerson, EventCode::PathBlocked] {
            assert_eq!(level(code), log::Level::Info, "{code:?}");
        }
        for code in [EventCode::SensorFault, EventCode::PoolFull, EventCode::Collision] {
            assert_eq!(level(code), log::Level::Warn, "{code:?}");
        }
    }

    #[test]
    fn a_refusal_names_what_the_robot_offers_and_what_the_server_requires() {
        let hello = Hello {
            version: 1,
            min_version: 1,
            robot: RobotId(7),
            nonce: 0,
            frame: 20,
            resolution: Millimetres(100),
            fused_tiles: 1,
        };
        let refused = |hello, reason| Event::Refused(hello, reason).to_string();
        assert_eq!(
            refused(hello, RefusalReason::Resolution(Millimetres(50))),
            "robot 7 is refused: it offers cells of 100 mm; this map has 50 mm"
        );
        let newer = Hello { version: 3, min_version: 2, ..hello };
        assert_eq!(
            refused(newer, RefusalReason::Version { min: MIN_VERSION, current: VERSION }),
            "robot 7 is refused: it speaks protocol versions 2 to 3; this server speaks 1 to 1"
        );
        assert_eq!(
            refused(hello, RefusalReason::Frame(32)),
            "robot 7 is refused: it can receive frames of 20 bytes; the minimum is 32"
        );
    }

    #[test]
    fn a_robot_without_a_number_is_a_warning_that_says_what_to_do() {
        let joined = |robot| Event::Joined(RobotId(robot), 2);
        assert_eq!(joined(7).to_string(), "robot 7 has a session on port 2");
        assert_eq!((joined(7).level(), joined(0).level()), (log::Level::Info, log::Level::Warn));
        assert!(joined(0).to_string().contains("ubimap provision"), "{}", joined(0));
    }

    pub(in crate::server) fn event(code: EventCode, detail: &str) -> message::Event {
        let severity = code.usual_severity();
        let detail = detail.parse().unwrap();
        message::Event { time: None, severity, code: code as u16, detail }
    }

    fn reported(detail: &str) -> Event {
        Event::Reported(RobotId(1), event(EventCode::LowBattery, detail))
    }

    #[test]
    fn text_of_a_robot_stays_on_its_line_and_in_its_order() {
        let line = reported("a\nubimap: error: \u{1b}[2J\u{202e}'é\"").to_string();
        assert!(line.contains("(a\\nubimap: error: \\u{1b}[2J\\u{202e}'é\")"), "{line}");
        assert_eq!(line.lines().count(), 1);
    }

    #[test]
    fn a_port_causes_a_limited_number_of_events_and_the_rest_is_counted() {
        let mut events = Events::default();
        let at = |seconds: u64| Instant(seconds * 1_000_000);
        for index in 0..100 {
            events.add_from(3, at(index / 20), reported("x"));
        }
        events.add_from(4, at(5), reported("y"));
        let polled = |events: &mut Events| core::iter::from_fn(|| events.poll()).count();
        assert_eq!(polled(&mut events), 21);
        events.timeout(at(9));
        assert_eq!(polled(&mut events), 0);
        events.timeout(at(10));
        let (_, event) = events.poll().unwrap();
        assert_eq!(
            event.to_string(),
            "port 3: 80 more events reported by robots are left out here"
        );
        events.add_from(3, at(11), reported("x"));
        assert_eq!(polled(&mut events), 1);
    }
}
