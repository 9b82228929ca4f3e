//! What counts as late or lost on a link, and how often each side repeats itself.

use crate::time::Duration;

/// How long an acknowledgement may wait for a frame to travel in.
pub(super) const ACK_DELAY: Duration = Duration::from_millis(5);
/// When an acknowledgement is repeated on a link that loses frames, after the one before. It is short,
/// and what is lost with it is a whole frame sent again.
pub(super) const ACK_REPEATS: [Duration; 2] =
    [Duration::from_millis(40), Duration::from_millis(70)];

/// A frame is late after this long while the round trip is not known: half of RFC 6298's second, for
/// these links are short.
pub(super) const FIRST_TIMEOUT: Duration = Duration::from_millis(500);
/// A frame is never late sooner than this, so that an acknowledgement that was held back, or lost once
/// and repeated, comes in time.
pub(super) const LEAST_TIMEOUT: Duration = Duration::from_millis(150);
/// A frame is always late after this long, however often it was sent: the link may work again.
pub(super) const MOST_TIMEOUT: Duration = Duration::from_secs(3);
/// A frame is lost, and not overtaken, if one that was sent this much later has arrived: frames
/// overtake each other by a few dozen milliseconds.
pub(super) const LEAST_REORDERING: Duration = Duration::from_millis(60);

/// Between the first hello and the second; each further wait is twice as long, up to 16 times.
pub(super) const HELLO_WAIT: Duration = Duration::from_millis(200);
/// Until a robot that was refused says hello again: the server may have been configured anew.
pub(super) const REFUSED_WAIT: Duration = Duration::from_secs(10);

/// Interval of time requests until the first minima are good: 64 of them take eight seconds.
pub(super) const FIRST_TIME_INTERVAL: Duration = Duration::from_millis(125);
/// Interval of time requests after that: in between clocks drift apart by less than 0.1 ms (15 ppm).
pub(super) const TIME_INTERVAL: Duration = Duration::from_secs(5);
/// A time reply that takes longer than this is lost: it would say little.
pub(super) const TIME_REPLY_LOST: Duration = Duration::from_secs(2);
