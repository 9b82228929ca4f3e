//! What somebody should know of: events on robots, sightings that can't be a pose, robots that
//! misbehave, people who lie on the floor.

use core::fmt;
use std::collections::{BTreeMap, VecDeque};

use ubimap_protocol::{
    message::{self, EventCode, RefusalReason, Severity},
    time::Instant,
    units::{Millimetres, RobotId},
};

use super::coordination::Notice;
use crate::perception::{Lying, robots::SightingEvent};

/// The newest events of a robot that are kept.
const MOST_KEPT: usize = 8;
/// Events that wait to be polled, at the most: then the oldest are dropped.
const MOST_WAITING: usize = 1_000;

/// Something to tell whoever runs the server.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A robot has a session on a port.
    Joined(RobotId, usize),
    /// A robot got no session.
    Refused(RobotId, RefusalReason),
    /// A robot reports an event.
    Reported(RobotId, message::Event),
    /// What cameras saw of a robot can't be a pose.
    Sighting(SightingEvent),
    /// A robot does what none should.
    Robot(RobotEvent),
    /// Something has happened to a person.
    Person(PersonEvent),
    /// The drive of a robot has come to something.
    Drive(RobotId, Notice),
}

impl Event {
    /// How much it matters.
    pub fn level(&self) -> log::Level {
        match self {
            Self::Joined(..) => log::Level::Info,
            Self::Reported(_, event) if event.severity == Severity::Info => log::Level::Info,
            Self::Drive(..) => log::Level::Debug,
            _ => log::Level::Warn,
        }
    }
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Joined(robot, port) => {
                write!(f, "robot {} has a session on port {port}", robot.0)
            }
            Self::Refused(robot, reason) => write!(f, "robot {} is refused: {reason:?}", robot.0),
            Self::Reported(robot, event) => write!(f, "robot {}: {}", robot.0, described(event)),
            Self::Sighting(event) => event.fmt(f),
            Self::Robot(event) => event.fmt(f),
            Self::Person(event) => event.fmt(f),
            Self::Drive(robot, notice) => write!(f, "robot {}: {notice:?}", robot.0),
        }
    }
}

/// The events that wait to be polled, and tallies of those that begin and pass.
#[derive(Debug, Default)]
pub(super) struct Events {
    waiting: VecDeque<(Instant, Event)>,
    sightings: Tally<SightingEvent>,
    robots: Tally<RobotEvent>,
    people: Tally<PersonEvent>,
}

impl Events {
    pub(super) fn add(&mut self, moment: Instant, event: Event) {
        match event {
            Event::Sighting(event) => self.sightings.add(moment, event),
            Event::Robot(event) => self.robots.add(moment, event),
            Event::Person(event) => self.people.add(moment, event),
            _ => {}
        }
        if self.waiting.len() >= MOST_WAITING {
            self.waiting.pop_front();
        }
        self.waiting.push_back((moment, event));
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

/// The events of one robot.
#[derive(Clone, Debug, Default)]
pub struct EventLog {
    count: u64,
    newest: VecDeque<(Instant, message::Event)>,
}

impl EventLog {
    pub(super) fn add(&mut self, received: Instant, event: message::Event) {
        self.count += 1;
        self.newest.push_back((received, event));
        if self.newest.len() > MOST_KEPT {
            self.newest.pop_front();
        }
    }

    /// All that were received.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The newest few and when they were received, oldest first.
    pub fn newest(&self) -> impl Iterator<Item = (Instant, &message::Event)> {
        self.newest.iter().map(|(received, event)| (*received, event))
    }
}

/// Misbehaviour of a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RobotEvent {
    /// What it draws or sees contradicts the others, and no constant error explains it.
    Disagrees(RobotId),
    /// It sends more than any agent would, or draws more ground than there is.
    Floods(RobotId),
}

impl fmt::Display for RobotEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Disagrees(robot) => {
                write!(f, "robot {} disagrees with what the others see; it counts less", robot.0)
            }
            Self::Floods(robot) => {
                write!(f, "robot {} sends too much; the rest is not read", robot.0)
            }
        }
    }
}

/// Something about a person that somebody should look at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum PersonEvent {
    /// Lies on the floor, here in `map`.
    Lies {
        /// Along x.
        x: Millimetres,
        /// Along y.
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
        write!(f, "somebody lies on the floor at ({:.1}, {:.1}) m", x.metres(), y.metres())
    }
}

/// How often each event of a kind has begun, and when last.
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

    /// Each event, how often it began, and when last.
    pub fn iter(&self) -> impl Iterator<Item = (E, u64, Instant)> {
        self.events.iter().map(|(&event, &(count, last))| (event, count, last))
    }
}

/// An event in a few words, such as "Warning: PoolFull".
pub fn described(event: &message::Event) -> String {
    let message::Event { severity, code, detail, .. } = event;
    let what = match EventCode::from_number(*code) {
        Some(known) => format!("{known:?}"),
        None => format!("code {code}"),
    };
    format!("{severity:?}: {what} {detail}").trim_end().to_owned()
}
