//! Round-trip time and retransmission timeout (RFC 6298, in integers).

use super::timing::{FIRST_TIMEOUT, MAX_TIMEOUT, MIN_REORDERING, MIN_TIMEOUT};
use crate::time::Duration;

/// The smoothed round-trip time and its variation, in microseconds; `None` before the first sample.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct RoundTrip {
    estimate: Option<(u64, u64)>,
}

impl RoundTrip {
    /// Takes the time from sending a frame to its acknowledgement. The frame must have been sent only
    /// once (Karn's algorithm).
    pub(super) fn sample(&mut self, span: Duration) {
        let span = span.micros().min(MAX_TIMEOUT.0);
        self.estimate = Some(match self.estimate {
            None => (span, span / 2),
            Some((smoothed, variation)) => {
                let error = smoothed.abs_diff(span);
                ((7 * smoothed + span) / 8, (3 * variation + error) / 4)
            }
        });
    }

    /// The retransmission timeout of a frame that was sent `sent` times.
    pub(super) fn timeout(&self, sent: u8) -> Duration {
        let once =
            self.estimate.map_or(FIRST_TIMEOUT.0, |(smoothed, variation)| smoothed + 4 * variation);
        let doubled = once.max(MIN_TIMEOUT.0) << u32::from(sent.saturating_sub(1)).min(4);
        Duration(doubled.min(MAX_TIMEOUT.0))
    }

    /// The reordering tolerance: a frame is considered lost when one sent at least this much later has
    /// been acknowledged.
    pub(super) fn reordering(&self) -> Duration {
        Duration(
            self.estimate
                .map_or(FIRST_TIMEOUT.0, |(smoothed, _)| smoothed / 4)
                .max(MIN_REORDERING.0),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_timeout_follows_the_round_trip_and_doubles() {
        let mut trip = RoundTrip::default();
        assert_eq!(trip.timeout(1), FIRST_TIMEOUT);
        for _ in 0..50 {
            trip.sample(Duration::from_millis(400));
        }
        let once = trip.timeout(1).micros();
        assert!((400_000..420_000).contains(&once), "{once}");
        assert_eq!(trip.timeout(2).micros(), 2 * once);
        assert_eq!(trip.timeout(200), MAX_TIMEOUT);
    }
}
