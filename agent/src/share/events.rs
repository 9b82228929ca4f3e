//! Events on the robot that are reported to the server.

use heapless::Vec;
use ubimap_protocol::{
    message::{Event, EventCode},
    time::Instant,
};

use crate::timing::EVENT_INTERVAL;

/// Number of different event codes that a robot raises; the newest event of each is stored.
const MAX_EVENTS: usize = 10;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Progress {
    Waiting,
    UnderWay,
    Arrived,
}

#[derive(Clone, Copy, Debug)]
struct Raised {
    code: EventCode,
    /// When the event happened, by the robot's clock.
    at: Instant,
    progress: Progress,
}

/// The newest event of each code. Each event is sent until it is acknowledged, across sessions.
#[derive(Debug, Default)]
pub struct Events {
    raised: Vec<Raised, MAX_EVENTS>,
}

impl Events {
    /// Records an event at `at` (robot's clock). It is ignored if the last event with the same code
    /// is not acknowledged yet, or is less than ten seconds old. The age does not matter for the
    /// end of a path and a blocked path, because the server waits for these.
    pub fn raise(&mut self, code: EventCode, at: Instant) {
        let new = Raised { code, at, progress: Progress::Waiting };
        match self.raised.iter_mut().find(|raised| raised.code == code) {
            Some(last) => {
                let is_awaited = matches!(code, EventCode::PathDone | EventCode::PathBlocked);
                let is_news = is_awaited || at >= last.at + EVENT_INTERVAL;
                if last.progress == Progress::Arrived && is_news {
                    *last = new;
                }
            }
            None => {
                let _ = self.raised.push(new);
            }
        }
    }

    /// Sends one of the waiting events: `push` writes the message and returns whether it fitted;
    /// `to_server` converts the event's time to the server's clock. Returns the code of the event,
    /// if one was sent.
    pub fn send(
        &mut self,
        to_server: impl FnOnce(Instant) -> Option<Instant>,
        push: impl FnOnce(&Event) -> bool,
    ) -> Option<EventCode> {
        let raised = self.raised.iter_mut().find(|it| it.progress == Progress::Waiting)?;
        let event = Event {
            time: to_server(raised.at),
            severity: raised.code.usual_severity(),
            code: raised.code as u16,
            detail: heapless::String::new(),
        };
        push(&event).then(|| {
            raised.progress = Progress::UnderWay;
            raised.code
        })
    }

    /// Processes the acknowledgement of an event's frame.
    pub fn acknowledged(&mut self, code: EventCode) {
        self.pass(Progress::UnderWay, Progress::Arrived, |raised| raised.code == code);
    }

    /// Starts a session: events in flight are lost, so they are sent again.
    pub fn begin_session(&mut self) {
        self.pass(Progress::UnderWay, Progress::Waiting, |_| true);
    }

    fn pass(&mut self, from: Progress, to: Progress, of: impl Fn(&Raised) -> bool) {
        for raised in self.raised.iter_mut().filter(|it| it.progress == from && of(it)) {
            raised.progress = to;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sent(events: &mut Events) -> Option<EventCode> {
        events.send(Some, |_| true)
    }

    #[test]
    fn an_event_is_sent_until_acknowledged_and_then_not_repeated_for_a_while() {
        let mut events = Events::default();
        let code = EventCode::PoolFull;
        let second = |second: u64| Instant(second * 1_000_000);
        events.raise(code, second(1));
        assert_eq!(events.send(Some, |_| false), None, "no room");
        assert_eq!(sent(&mut events), Some(code));
        events.raise(code, second(20));
        assert_eq!(sent(&mut events), None, "in flight");
        events.begin_session();
        assert_eq!(sent(&mut events), Some(code));
        events.acknowledged(EventCode::PoseLost);
        events.begin_session();
        assert_eq!(sent(&mut events), Some(code));
        events.acknowledged(code);
        events.begin_session();
        for (at, told) in [(10, None), (11, Some(code)), (40, None)] {
            events.raise(code, second(at));
            assert_eq!(sent(&mut events), told, "at {at}");
        }
    }

    #[test]
    fn events_that_the_server_waits_for_are_always_sent() {
        let mut events = Events::default();
        for code in [EventCode::PathDone, EventCode::PathBlocked] {
            for second in 1..3 {
                events.raise(code, Instant(second * 1_000_000));
                assert_eq!(sent(&mut events), Some(code));
                events.acknowledged(code);
            }
        }
    }

    #[test]
    fn codes_are_independent() {
        let mut events = Events::default();
        let codes = [EventCode::Started, EventCode::PoseLost, EventCode::ScanOverflow];
        codes.iter().for_each(|&code| events.raise(code, Instant(5)));
        assert!(codes.iter().all(|&code| sent(&mut events) == Some(code)));
        assert_eq!(sent(&mut events), None);
    }
}
