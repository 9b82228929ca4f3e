//! What happened on the robot and the server should know.

use heapless::Vec;
use ubimap_protocol::{
    message::{Event, EventCode},
    time::Instant,
};

use crate::timing::EVENT_INTERVAL;

/// One for each code that the robot has.
const MOST: usize = 10;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Progress {
    Waiting,
    UnderWay,
    Arrived,
}

#[derive(Clone, Copy, Debug)]
struct Raised {
    code: EventCode,
    /// By the robot's clock.
    at: Instant,
    progress: Progress,
}

/// The newest event of each code. Each is told until it has arrived, whatever becomes of sessions.
#[derive(Debug, Default)]
pub struct Events {
    raised: Vec<Raised, MOST>,
}

impl Events {
    /// Something happened at `at` (robot's clock). It is passed over if the last event of this code
    /// has not arrived, or is not old enough; but that a path ends, or leads nowhere, for which the
    /// server waits, is news each time.
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

    /// Sends an event: `push` has the message and tells whether there was room. `to_server` gives
    /// its time by the server's clock. The event's code, if one was sent.
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

    /// The frame of an event has been acknowledged.
    pub fn acknowledged(&mut self, code: EventCode) {
        self.pass(Progress::UnderWay, Progress::Arrived, |raised| raised.code == code);
    }

    /// A session has begun: what was under way is lost.
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
    fn an_event_is_told_until_it_has_arrived_and_then_not_for_a_while() {
        let mut events = Events::default();
        let code = EventCode::PoolFull;
        let second = |second: u64| Instant(second * 1_000_000);
        events.raise(code, second(1));
        assert_eq!(events.send(Some, |_| false), None, "no room");
        assert_eq!(sent(&mut events), Some(code));
        events.raise(code, second(20));
        assert_eq!(sent(&mut events), None, "it is under way");
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
    fn what_the_server_waits_for_is_told_each_time() {
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
    fn codes_do_not_wait_for_each_other() {
        let mut events = Events::default();
        let codes = [EventCode::Started, EventCode::PoseLost, EventCode::ScanOverflow];
        codes.iter().for_each(|&code| events.raise(code, Instant(5)));
        assert!(codes.iter().all(|&code| sent(&mut events) == Some(code)));
        assert_eq!(sent(&mut events), None);
    }
}
