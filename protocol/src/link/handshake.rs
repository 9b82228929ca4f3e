//! Hello and welcome: what the two sides agree on before anything else.
//!
//! The robot knocks until it is answered, ever more slowly. A server that hears frames of a
//! session it does not know answers with a reset, and the robot knocks at once: a rebooted side
//! is noticed with the first frame that reaches it.

use super::timing::{HELLO_WAIT, REFUSED_WAIT};
use crate::{
    frame::{MAX_FRAME, MIN_FRAME, MIN_VERSION, VERSION},
    message::{Hello, Refusal, RefusalReason, Welcome},
    time::{Duration, Instant},
    units::{Millimetres, SessionId},
};

/// How often the wait for an answer to a hello is doubled.
const DOUBLINGS: u32 = 4;

/// The robot's side: when to say hello.
#[derive(Debug)]
pub struct Knocking {
    boot_nonce: u32,
    /// Sessions begun or reset since the boot; part of the nonce.
    attempts: u32,
    knocks: u32,
    next: Instant,
}

impl Knocking {
    /// `boot_nonce` should differ from boot to boot.
    pub fn new(boot_nonce: u32) -> Self {
        Self { boot_nonce, attempts: 0, knocks: 0, next: Instant(0) }
    }

    /// The nonce of the hellos of this attempt.
    pub fn nonce(&self) -> u32 {
        self.boot_nonce.wrapping_add(self.attempts.wrapping_mul(0x9E37_79B9))
    }

    /// Whether a hello is due; it then counts as sent.
    #[must_use]
    pub fn poll(&mut self, now: Instant) -> bool {
        let due = now >= self.next;
        if due {
            self.next = now + Duration(HELLO_WAIT.0 << self.knocks.min(DOUBLINGS));
            self.knocks = self.knocks.saturating_add(1);
        }
        due
    }

    /// When the next hello is due.
    pub fn poll_timeout(&self) -> Instant {
        self.next
    }

    /// The session was lost: knock anew, at once.
    pub fn restart(&mut self, now: Instant) {
        self.attempts = self.attempts.wrapping_add(1);
        self.knocks = 0;
        self.next = now;
    }

    /// The server refused: ask again after a while, it may have been reconfigured.
    pub fn refused(&mut self, now: Instant) {
        self.next = now + REFUSED_WAIT;
    }
}

/// What a server asks of a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Terms {
    /// The side of the map's cells.
    pub resolution: Millimetres,
    /// The largest frame that the server can take, in bytes on the wire.
    pub frame: u16,
    /// The server's epoch.
    pub server_epoch: u32,
    /// Whether the server says when a tile is on disk.
    pub stores: bool,
}

/// A server's answer to a hello.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// There is a session.
    Welcome(Welcome),
    /// There is none.
    Refusal(Refusal),
}

/// Answers a hello: with a welcome to `session`, or with what does not match.
pub fn answer(hello: &Hello, terms: &Terms, session: SessionId, first_epoch: u32) -> Answer {
    let refuse = |reason| Answer::Refusal(Refusal { nonce: hello.nonce, reason });
    if hello.min_version > VERSION || hello.version < MIN_VERSION {
        return refuse(RefusalReason::Version { min: MIN_VERSION, current: VERSION });
    }
    if hello.resolution != terms.resolution {
        return refuse(RefusalReason::Resolution(terms.resolution));
    }
    if usize::from(hello.frame) < MIN_FRAME {
        return refuse(RefusalReason::Frame(MIN_FRAME as u16));
    }
    Answer::Welcome(Welcome {
        nonce: hello.nonce,
        version: hello.version.min(VERSION),
        session,
        frame: hello.frame.min(terms.frame).min(MAX_FRAME as u16),
        server_epoch: terms.server_epoch,
        first_epoch,
        stores: terms.stores,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::RobotId;

    const TERMS: Terms =
        Terms { resolution: Millimetres(50), frame: 200, server_epoch: 3, stores: false };

    fn hello() -> Hello {
        Hello {
            version: VERSION,
            min_version: MIN_VERSION,
            robot: RobotId(1),
            nonce: 99,
            frame: 250,
            resolution: Millimetres(50),
            fused_tiles: 16,
        }
    }

    #[test]
    fn both_sides_get_the_smaller_frame() {
        let Answer::Welcome(welcome) = answer(&hello(), &TERMS, SessionId(7), 5) else { panic!() };
        assert_eq!((welcome.frame, welcome.nonce, welcome.first_epoch), (200, 99, 5));
    }

    #[test]
    fn a_mismatch_is_named() {
        let reason = |hello| match answer(&hello, &TERMS, SessionId(7), 5) {
            Answer::Refusal(refusal) => refusal.reason,
            Answer::Welcome(_) => panic!(),
        };
        assert_eq!(
            reason(Hello { version: 9, min_version: 8, ..hello() }),
            RefusalReason::Version { min: MIN_VERSION, current: VERSION }
        );
        assert_eq!(
            reason(Hello { resolution: Millimetres(100), ..hello() }),
            RefusalReason::Resolution(Millimetres(50))
        );
        assert_eq!(reason(Hello { frame: 31, ..hello() }), RefusalReason::Frame(32));
    }

    #[test]
    fn knocks_come_ever_more_slowly_until_the_session_is_lost() {
        let mut knocking = Knocking::new(5);
        let mut times = std::vec::Vec::new();
        for now in (0..20_000).map(|ms| Instant(ms * 1000)) {
            if knocking.poll(now) {
                times.push(now.0 / 1000);
            }
        }
        assert_eq!(times[..5], [0, 200, 600, 1400, 3000]);
        assert_eq!(times[6] - times[5], 3200);
        let nonce = knocking.nonce();
        knocking.restart(Instant(20_000_000));
        assert!(knocking.poll(Instant(20_000_000)));
        assert_ne!(knocking.nonce(), nonce);
    }
}
