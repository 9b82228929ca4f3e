//! How long a frame and its acknowledgement take (RFC 6298, integers).

use super::timing::{FIRST_TIMEOUT, LEAST_REORDERING, LEAST_TIMEOUT, MOST_TIMEOUT};
use crate::time::Duration;

/// The smoothed round trip and its variation, in microseconds.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct RoundTrip {
    estimate: Option<(u64, u64)>,
}

impl RoundTrip {
    /// Takes the time between a frame that was sent once and its acknowledgement.
    pub(super) fn sample(&mut self, span: Duration) {
        let span = span.micros().min(MOST_TIMEOUT.0);
        self.estimate = Some(match self.estimate {
            None => (span, span / 2),
            Some((smoothed, variation)) => {
                let error = smoothed.abs_diff(span);
                ((7 * smoothed + span) / 8, (3 * variation + error) / 4)
            }
        });
    }

    /// How long to wait for an acknowledgement of a frame that was sent this often.
    pub(super) fn timeout(&self, sent: u8) -> Duration {
        let once =
            self.estimate.map_or(FIRST_TIMEOUT.0, |(smoothed, variation)| smoothed + 4 * variation);
        let doubled = once.max(LEAST_TIMEOUT.0) << u32::from(sent.saturating_sub(1)).min(4);
        Duration(doubled.min(MOST_TIMEOUT.0))
    }

    /// How much later than a lost frame another one must have been sent, and acknowledged, for
    /// the loss to be believed: frames may overtake each other by a few dozen milliseconds.
    pub(super) fn reordering(&self) -> Duration {
        Duration(
            self.estimate
                .map_or(FIRST_TIMEOUT.0, |(smoothed, _)| smoothed / 4)
                .max(LEAST_REORDERING.0),
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
        assert_eq!(trip.timeout(200), MOST_TIMEOUT);
    }
}
