//! How a robot's link to its server is, in words, for the log of `ubimap robot`.

use log::Level;
use ubimap_protocol::{
    message::RefusalReason,
    time::{Duration, Instant},
};

/// A server that is silent for this long is lost: the robot has stopped for lack of it after two seconds.
const SILENT: Duration = Duration::from_secs(3);

/// A robot's contact with its server.
#[derive(Debug)]
pub(super) struct Contact {
    server: String,
    /// When bytes last came; at first, when the robot started.
    heard: Instant,
    state: State,
    /// Whether the robot ever had a session.
    was_up: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Waiting,
    NoAnswer,
    Up,
    Lost,
    Refused(RefusalReason),
}

impl Contact {
    /// A robot that starts at `now`.
    pub(super) fn new(server: String, now: Instant) -> Self {
        Self { server, heard: now, state: State::Waiting, was_up: false }
    }

    /// Bytes came from the server.
    pub(super) fn hears(&mut self, now: Instant) {
        self.heard = now;
    }

    /// What there is to tell when the contact has changed.
    pub(super) fn follow(
        &mut self,
        is_connected: bool,
        refusal: Option<RefusalReason>,
        now: Instant,
    ) -> Option<(Level, String)> {
        let is_silent = now.since(self.heard) >= SILENT;
        let state = match (refusal, self.state) {
            _ if is_connected && !is_silent => State::Up,
            (Some(reason), _) if !is_silent => State::Refused(reason),
            (_, State::Up | State::Lost) if is_silent || !is_connected => State::Lost,
            _ if is_silent => State::NoAnswer,
            (_, state) => state,
        };
        if state == self.state {
            return None;
        }
        let (server, again) = (&self.server, if self.was_up { " again" } else { "" });
        let told = match state {
            State::Waiting => return None,
            State::Up => (Level::Info, format!("connected to the server at {server}{again}")),
            State::NoAnswer => (
                Level::Warn,
                format!(
                    "no answer from a server at {server}: does ubimap serve run there, and do both sides have the \
                     robot's key, or none? Trying on"
                ),
            ),
            State::Lost => (
                Level::Warn,
                format!("lost the server at {server}: the robot stands until it answers again"),
            ),
            State::Refused(reason) => {
                (Level::Warn, format!("the server at {server} refuses this robot: {reason}"))
            }
        };
        (self.state, self.was_up) = (state, self.was_up || state == State::Up);
        Some(told)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_change_is_told_once() {
        let at = |second: u64| Instant(second * 1_000_000);
        let mut contact = Contact::new("udp:4000".into(), at(0));
        let mut told = |second: u64, hears: bool, is_connected: bool, refusal| {
            if hears {
                contact.hears(at(second));
            }
            contact.follow(is_connected, refusal, at(second)).map(|(_, text)| text)
        };
        assert_eq!(told(2, false, false, None), None);
        assert!(
            told(3, false, false, None).unwrap().starts_with("no answer from a server at udp:4000")
        );
        assert_eq!(told(20, false, false, None), None);
        assert_eq!(told(21, true, true, None).unwrap(), "connected to the server at udp:4000");
        assert_eq!(told(22, true, true, None), None);
        // A session outlives its server.
        assert!(told(25, false, true, None).unwrap().starts_with("lost the server at udp:4000"));
        assert_eq!(told(60, false, false, None), None);
        let reason = RefusalReason::NumberInUse;
        assert!(
            told(61, true, false, Some(reason)).unwrap().contains("refuses this robot: another")
        );
        assert_eq!(told(62, true, false, Some(reason)), None);
        assert_eq!(
            told(63, true, true, None).unwrap(),
            "connected to the server at udp:4000 again"
        );
    }
}
