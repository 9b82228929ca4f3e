//! The handshake, Hello and Welcome: both sides agree on their parameters before anything else.
//!
//! The robot sends a Hello until it is answered, at increasing intervals. A server that receives
//! frames of an unknown session answers with a Reset, after which the robot sends a Hello at once.
//! So either side notices a reboot of the other with the first frame that arrives.

use super::timing::{HELLO_WAIT, NUMBER_WAIT, REFUSED_WAIT};
use crate::{
    frame::{MAX_FRAME, MIN_FRAME, MIN_SEALED_FRAME, MIN_VERSION, VERSION},
    message::{Hello, Refusal, RefusalReason, Welcome},
    time::{Duration, Instant},
    units::{Millimetres, SessionId},
};

/// Number of times that the interval between Hellos doubles.
const DOUBLINGS: u32 = 4;

/// Difference between the nonces of two successive attempts.
const NONCE_STEP: u32 = 0x9E37_79B9;

/// The robot's side: decides when to send a Hello.
#[derive(Debug)]
pub struct Knocking {
    boot_nonce: u32,
    /// Number of sessions lost since boot, each of which starts a new attempt; part of the nonce.
    attempts: u32,
    hellos: u32,
    next: Instant,
}

impl Knocking {
    /// Starts the first attempt; a hello is due at once. `boot_nonce` should differ from boot to
    /// boot.
    pub fn new(boot_nonce: u32) -> Self {
        Self { boot_nonce, attempts: 0, hellos: 0, next: Instant(0) }
    }

    /// The nonce in the hellos of this attempt.
    pub fn nonce(&self) -> u32 {
        self.boot_nonce.wrapping_add(self.attempts.wrapping_mul(NONCE_STEP))
    }

    /// Whether a hello is due now; if so, it counts as sent.
    #[must_use]
    pub fn poll(&mut self, now: Instant) -> bool {
        let due = now >= self.next;
        if due {
            self.next = now + Duration(HELLO_WAIT.0 << self.hellos.min(DOUBLINGS));
            self.hellos = self.hellos.saturating_add(1);
        }
        due
    }

    /// When the next hello is due.
    pub fn poll_timeout(&self) -> Instant {
        self.next
    }

    /// Starts a new attempt at once, after the session was lost.
    pub fn restart(&mut self, now: Instant) {
        self.attempts = self.attempts.wrapping_add(1);
        self.hellos = 0;
        self.next = now;
    }

    /// Postpones the next hello after a refusal.
    pub fn refused(&mut self, reason: RefusalReason, now: Instant) {
        let is_brief = reason == RefusalReason::NumberInUse;
        self.next = now + if is_brief { NUMBER_WAIT } else { REFUSED_WAIT };
    }
}

/// The terms on which a server accepts robots.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Terms {
    /// The side of the map's cells.
    pub resolution: Millimetres,
    /// The largest frame that the server can receive, in bytes on the wire.
    pub frame: u16,
    /// The server's epoch.
    pub server_epoch: u32,
    /// Whether the server confirms when a tile is on disk.
    pub stores: bool,
}

/// A server's answer to a hello.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// The session begins.
    Welcome(Welcome),
    /// The robot and the server do not match.
    Refusal(Refusal),
}

/// Answers a hello with a welcome to `session`, or with a refusal that names the first mismatch.
/// The welcome does not renumber the robot's tiles.
pub fn answer(hello: &Hello, terms: &Terms, session: SessionId, first_epoch: u32) -> Answer {
    answer_from(hello, terms, session, first_epoch, MIN_FRAME)
}

/// Answers a hello on a sealed link, whose frames must be larger: see [`answer`].
pub fn answer_sealed(hello: &Hello, terms: &Terms, session: SessionId, first_epoch: u32) -> Answer {
    answer_from(hello, terms, session, first_epoch, MIN_SEALED_FRAME)
}

fn answer_from(
    hello: &Hello,
    terms: &Terms,
    session: SessionId,
    first_epoch: u32,
    min_frame: usize,
) -> Answer {
    let refuse = |reason| Answer::Refusal(Refusal { nonce: hello.nonce, reason });
    if hello.min_version > VERSION || hello.version < MIN_VERSION {
        return refuse(RefusalReason::Version { min: MIN_VERSION, current: VERSION });
    }
    if hello.resolution != terms.resolution {
        return refuse(RefusalReason::Resolution(terms.resolution));
    }
    if usize::from(hello.frame) < min_frame {
        return refuse(RefusalReason::Frame(min_frame as u16));
    }
    Answer::Welcome(Welcome {
        nonce: hello.nonce,
        version: hello.version.min(VERSION),
        session,
        frame: hello.frame.min(terms.frame).min(MAX_FRAME as u16),
        server_epoch: terms.server_epoch,
        first_epoch,
        stores: terms.stores,
        renumber: false,
    })
}

/// Whether two nonces are of the same boot of a robot: fewer than 65,536 attempts lie between them,
/// in either direction. Nonces of different boots pass this test with a probability of 1 in 32,768.
pub fn is_same_boot(one: u32, other: u32) -> bool {
    const INVERSE: u32 = 0x144C_BC89;
    const { assert!(NONCE_STEP.wrapping_mul(INVERSE) == 1) };
    let attempts = one.wrapping_sub(other).wrapping_mul(INVERSE);
    attempts < 1 << 16 || attempts.wrapping_neg() < 1 << 16
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
    fn both_sides_agree_on_the_smaller_frame() {
        let Answer::Welcome(welcome) = answer(&hello(), &TERMS, SessionId(7), 5) else { panic!() };
        assert_eq!((welcome.frame, welcome.nonce, welcome.first_epoch), (200, 99, 5));
    }

    #[test]
    fn versions_that_overlap_and_the_smallest_frame_are_welcome() {
        let newer = Hello { version: VERSION + 8, min_version: VERSION, ..hello() };
        let older = Hello { version: MIN_VERSION, min_version: 0, ..hello() };
        for (hello, version) in [(newer, VERSION), (older, MIN_VERSION)] {
            let hello = Hello { frame: MIN_FRAME as u16, ..hello };
            let answer = answer(&hello, &TERMS, SessionId(7), 5);
            let Answer::Welcome(welcome) = answer else { panic!("{answer:?}") };
            assert_eq!((welcome.version, welcome.frame), (version, MIN_FRAME as u16));
        }
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
            reason(Hello { version: MIN_VERSION - 1, min_version: 0, ..hello() }),
            RefusalReason::Version { min: MIN_VERSION, current: VERSION }
        );
        assert_eq!(
            reason(Hello { resolution: Millimetres(100), ..hello() }),
            RefusalReason::Resolution(Millimetres(50))
        );
        assert_eq!(reason(Hello { frame: 31, ..hello() }), RefusalReason::Frame(32));
    }

    #[test]
    fn hello_intervals_grow_until_the_session_is_lost() {
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
        assert_eq!(knocking.poll_timeout(), Instant(20_200_000), "the intervals start again");
        knocking.refused(RefusalReason::NumberInUse, Instant(20_100_000));
        assert_eq!(knocking.poll_timeout(), Instant(23_100_000));
        knocking.refused(RefusalReason::Frame(32), Instant(20_100_000));
        assert_eq!(knocking.poll_timeout(), Instant(30_100_000));
        assert!(!knocking.poll(Instant(30_099_999)) && knocking.poll(Instant(30_100_000)));
    }

    #[test]
    fn attempts_and_boots_have_nonces_of_their_own() {
        let mut nonces = std::collections::BTreeSet::new();
        for boot_nonce in [0, 1, 5, u32::MAX] {
            let mut knocking = Knocking::new(boot_nonce);
            assert_eq!(knocking.nonce(), boot_nonce);
            for _ in 0..1_000 {
                assert!(nonces.insert(knocking.nonce()));
                knocking.restart(Instant(0));
            }
        }
    }

    #[test]
    fn nonces_tell_boots_apart() {
        let nonces = |boot_nonce: u32| {
            let mut knocking = Knocking::new(boot_nonce);
            core::array::from_fn::<u32, 300, _>(|_| {
                knocking.restart(Instant(0));
                knocking.nonce()
            })
        };
        let [first, second] = [nonces(7), nonces(0xDEAD_BEEF)];
        for nonce in first {
            assert!(is_same_boot(7, nonce) && is_same_boot(nonce, first[150]));
            assert!(!is_same_boot(nonce, 0xDEAD_BEEF) && !is_same_boot(second[9], nonce));
        }
    }
}
