//! Timeouts and intervals of the link.

use crate::time::Duration;

/// Maximum time that an acknowledgement waits for a frame to travel in.
pub(super) const ACK_DELAY: Duration = Duration::from_millis(5);
/// Delays after which an acknowledgement is repeated on a lossy link, each counted from the one
/// before. Repeating is cheap: an acknowledgement is short, and losing it costs the retransmission
/// of a whole frame.
pub(super) const ACK_REPEATS: [Duration; 2] =
    [Duration::from_millis(40), Duration::from_millis(70)];

/// Retransmission timeout before the first round-trip sample: half of the one second in RFC 6298,
/// because these links are short.
pub(super) const FIRST_TIMEOUT: Duration = Duration::from_millis(500);
/// Minimum retransmission timeout. It leaves time for an acknowledgement that is delayed, or that
/// is lost once and repeated.
pub(super) const MIN_TIMEOUT: Duration = Duration::from_millis(150);
/// Maximum retransmission timeout, however often a frame was sent: the link may have recovered.
pub(super) const MAX_TIMEOUT: Duration = Duration::from_secs(3);
/// Minimum reordering tolerance: frames may overtake each other by a few dozen milliseconds.
pub(super) const MIN_REORDERING: Duration = Duration::from_millis(60);

/// Interval between the first two hellos; each further interval doubles, up to 16 times this one.
pub(super) const HELLO_WAIT: Duration = Duration::from_millis(200);
/// Interval before a refused robot says hello again: the server may have been reconfigured.
pub(super) const REFUSED_WAIT: Duration = Duration::from_secs(10);
/// Interval before the next hello of a robot that was refused because its number is in use. If it
/// has moved to another port, the server accepts it once the session on the old port counts as
/// dead.
pub(super) const NUMBER_WAIT: Duration = Duration::from_secs(3);

/// Interval of time requests until the first minima are good: 64 requests take eight seconds.
pub(super) const FIRST_TIME_INTERVAL: Duration = Duration::from_millis(125);
/// Interval of time requests after that: clocks drift apart by less than 0.1 ms in between (15
/// ppm).
pub(super) const TIME_INTERVAL: Duration = Duration::from_secs(5);
/// Timeout of a time reply: a reply that takes longer adds little accuracy.
pub(super) const TIME_REPLY_LOST: Duration = Duration::from_secs(2);
