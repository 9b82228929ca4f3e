//! What has happened on a robot, what the cameras saw of robots that is no pose, and what robots do
//! that none should.

use core::fmt;
use std::collections::{BTreeMap, VecDeque};

use ubimap_protocol::{
    message::{Event, EventCode},
    time::Instant,
    units::{Millimetres, RobotId},
};

use crate::perception::Lying;

/// The newest events that are kept.
const MOST: usize = 8;

/// The events of one robot.
#[derive(Clone, Debug, Default)]
pub struct EventLog {
    count: u64,
    newest: VecDeque<(Instant, Event)>,
}

impl EventLog {
    pub(super) fn add(&mut self, received: Instant, event: Event) {
        self.count += 1;
        self.newest.push_back((received, event));
        if self.newest.len() > MOST {
            self.newest.pop_front();
        }
    }

    /// All that were received.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The newest few and when they were received, oldest first.
    pub fn newest(&self) -> impl Iterator<Item = (Instant, &Event)> {
        self.newest.iter().map(|(received, event)| (*received, event))
    }
}

/// What a robot does and none should.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RobotEvent {
    /// What it draws or sees is not what the others do, and no constant error explains it.
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

/// What happens to a person and somebody should look at.
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

/// Events that begin and pass: what the cameras saw of robots and cannot be a pose
/// ([`SightingEvent`](crate::perception::robots::SightingEvent)), what robots do ([`RobotEvent`]) and
/// what happens to people ([`PersonEvent`]).
#[derive(Clone, Debug)]
pub struct Began<E> {
    events: BTreeMap<E, (u64, Instant)>,
}

impl<E> Default for Began<E> {
    fn default() -> Self {
        Self { events: BTreeMap::new() }
    }
}

impl<E: Copy + Ord + fmt::Display> Began<E> {
    pub(super) fn add(&mut self, moment: Instant, event: E) {
        log::warn!("{event}");
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
pub fn described(event: &Event) -> String {
    let Event { severity, code, detail, .. } = event;
    let what = match EventCode::from_number(*code) {
        Some(known) => format!("{known:?}"),
        None => format!("code {code}"),
    };
    format!("{severity:?}: {what} {detail}").trim_end().to_owned()
}
