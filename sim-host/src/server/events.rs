//! What has happened on a robot, and what the cameras saw of robots that is no pose.

use std::collections::{BTreeMap, VecDeque};

use ubimap_protocol::{
    message::{Event, EventCode},
    time::Instant,
};

use crate::perception::robots::SightingEvent;

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

/// What the cameras saw of robots and cannot be a pose.
#[derive(Clone, Debug, Default)]
pub struct SightingLog {
    seen: BTreeMap<SightingEvent, (u64, Instant)>,
}

impl SightingLog {
    pub(super) fn add(&mut self, captured: Instant, event: SightingEvent) {
        let (count, last) = self.seen.entry(event).or_insert((0, captured));
        *count += 1;
        *last = captured.max(*last);
    }

    /// Each event, how often it began, and when last.
    pub fn iter(&self) -> impl Iterator<Item = (SightingEvent, u64, Instant)> {
        self.seen.iter().map(|(&event, &(count, last))| (event, count, last))
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
