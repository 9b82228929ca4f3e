//! Round-trip time and retransmission timeout (RFC 6298, in integers).

use super::timing::{FIRST_TIMEOUT, MAX_TIMEOUT, MIN_REORDERING, MIN_TIMEOUT};
use crate::time::Duration;

/// The smoothed round-trip time and its variation, in microseconds; `None` before the first sample.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct RoundTrip {
    estimate: Option<(u64, u64)>,
}

impl RoundTrip {
    /// Updates the estimates with `span`, the time from sending a frame to its acknowledgement. The
    /// frame must have been sent only once (Karn's algorithm).
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

    /// The reordering tolerance: a frame is considered lost when one sent at least this much later
    /// has been acknowledged.
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
    use proptest::prelude::*;

    proptest! {
        /// Equations 2.2 and 2.3 of RFC 6298, with its gains of 1/8 and 1/4.
        #[test]
        fn estimates_are_those_of_the_rfc(spans in proptest::collection::vec(1u64..4_000_000, 1..40)) {
            let mut trip = RoundTrip::default();
            let (mut smoothed, mut variation) = (0.0, 0.0);
            for (index, &span) in spans.iter().enumerate() {
                trip.sample(Duration(span));
                let span = span.min(3_000_000) as f64;
                (smoothed, variation) = match index {
                    0 => (span, span / 2.0),
                    _ => (
                        0.875 * smoothed + 0.125 * span,
                        0.75 * variation + 0.25 * f64::abs(smoothed - span),
                    ),
                };
                // Each sample rounds twice, and rounding errors decay.
                let is_near = |found: Duration, expected: f64| (found.0 as f64 - expected).abs() < 60.0;
                let once = (smoothed + 4.0 * variation).max(150_000.0);
                for (sent, factor) in [(0, 1.0), (1, 1.0), (2, 2.0), (3, 4.0), (5, 16.0), (6, 16.0)] {
                    let expected = (factor * once).min(3_000_000.0);
                    let found = trip.timeout(sent);
                    prop_assert!((found.0 as f64 - expected).abs() < 60.0 * factor, "{found:?} {expected}");
                }
                prop_assert!(is_near(trip.reordering(), (smoothed / 4.0).max(60_000.0)));
            }
        }
    }

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
