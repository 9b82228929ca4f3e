//! What a robot has reported, for the operator.

use std::collections::VecDeque;

use ubimap_protocol::{message, time::Instant};

use super::events::is_routine;

/// Number of different events kept per robot.
const MAX_KEPT: usize = 8;

/// The events of one robot. Repetitions of an event are folded into one entry, and routine ones give way to
/// others, so that a warning is still there after an hour of finished paths.
#[derive(Clone, Debug, Default)]
pub struct EventLog {
    count: u64,
    newest: VecDeque<LoggedEvent>,
}

/// An event that a robot reported, once or several times.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedEvent {
    /// When it was first received, of the times counted here.
    pub first: Instant,
    /// When it was last received.
    pub last: Instant,
    /// How often it was received.
    pub times: u32,
    /// The event as last received.
    pub event: message::Event,
}

impl LoggedEvent {
    fn repeats(&self, event: &message::Event) -> bool {
        let kind = |it: &message::Event| (it.severity, it.code);
        kind(&self.event) == kind(event) && self.event.detail == event.detail
    }
}

impl EventLog {
    pub(super) fn add(&mut self, received: Instant, event: message::Event) {
        self.count += 1;
        let earlier = self.newest.iter().position(|it| it.repeats(&event));
        let logged = match earlier.and_then(|at| self.newest.remove(at)) {
            Some(it) => {
                LoggedEvent { last: received, times: it.times.saturating_add(1), event, ..it }
            }
            None => LoggedEvent { first: received, last: received, times: 1, event },
        };
        self.newest.push_back(logged);
        if self.newest.len() > MAX_KEPT {
            let routine = self.newest.iter().position(|it| is_routine(&it.event));
            self.newest.remove(routine.unwrap_or(0));
        }
    }

    /// Number of all events received.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The newest events, in the order in which they were last received.
    pub fn newest(&self) -> impl Iterator<Item = &LoggedEvent> {
        self.newest.iter()
    }
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::message::EventCode;

    use super::*;
    use crate::server::events::tests::event;

    #[test]
    fn finished_paths_do_not_push_a_warning_out() {
        let mut log = EventLog::default();
        log.add(Instant(1), event(EventCode::Collision, "left"));
        for at in 2..100 {
            log.add(Instant(at), event(EventCode::PathDone, ""));
            log.add(Instant(at), event(EventCode::PathBlocked, ""));
        }
        let kept: Vec<_> = log.newest().map(|it| (it.event.code, it.times)).collect();
        let [collision, done, blocked] =
            [EventCode::Collision, EventCode::PathDone, EventCode::PathBlocked].map(|it| it as u16);
        assert_eq!(kept, [(collision, 1), (done, 98), (blocked, 98)]);
        assert_eq!(
            log.newest().last().map(|it| (it.first, it.last)),
            Some((Instant(2), Instant(99)))
        );
        assert_eq!(log.count(), 197);
        // Of more different ones than there is room for, routine ones go first, then the oldest.
        for place in ["ahead", "right", "behind", "a", "b", "c", "d"] {
            log.add(Instant(200), event(EventCode::Collision, place));
        }
        let details: Vec<_> = log.newest().map(|it| it.event.detail.as_str().to_owned()).collect();
        assert_eq!(details, ["left", "ahead", "right", "behind", "a", "b", "c", "d"]);
        log.add(Instant(201), event(EventCode::Collision, "e"));
        assert_eq!(log.newest().next().unwrap().event.detail.as_str(), "ahead");
    }
}
