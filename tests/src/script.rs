//! Scripted events for a fleet.

use std::collections::VecDeque;

use ubimap_protocol::time::Instant;
use ubimap_sim_host::run::fleet::{Event, Stage};

/// Events, ordered by time.
#[derive(Debug, Default)]
pub struct Script(pub VecDeque<(Instant, Event)>);

impl Stage for Script {
    fn next_event(&self) -> Option<Instant> {
        Some(self.0.front()?.0)
    }

    fn poll(&mut self, now: Instant) -> Option<Event> {
        let due = self.0.front().is_some_and(|(moment, _)| *moment <= now);
        due.then(|| self.0.pop_front()).flatten().map(|(_, event)| event)
    }
}
