//! How long a frame and its acknowledgement take (RFC 6298, integers).

use crate::time::Duration;

const INITIAL: u64 = 500_000;
const LEAST: u64 = 150_000;
const MOST: u64 = 3_000_000;

/// The smoothed round trip and its variation, in microseconds.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct RoundTrip {
    estimate: Option<(u64, u64)>,
}

impl RoundTrip {
    /// Takes the time between a frame that was sent once and its acknowledgement.
    pub(super) fn sample(&mut self, span: Duration) {
        let span = span.micros().min(MOST);
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
        let once = self.estimate.map_or(INITIAL, |(smoothed, variation)| smoothed + 4 * variation);
        let doubled = once.max(LEAST) << u32::from(sent.saturating_sub(1)).min(4);
        Duration(doubled.min(MOST))
    }

    /// How much later than a lost frame another one must have been sent, and acknowledged, for
    /// the loss to be believed: frames may overtake each other by a few dozen milliseconds.
    pub(super) fn reordering(&self) -> Duration {
        Duration(self.estimate.map_or(INITIAL, |(smoothed, _)| smoothed / 4).max(60_000))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_timeout_follows_the_round_trip_and_doubles() {
        let mut trip = RoundTrip::default();
        assert_eq!(trip.timeout(1), Duration(INITIAL));
        for _ in 0..50 {
            trip.sample(Duration::from_millis(400));
        }
        let once = trip.timeout(1).micros();
        assert!((400_000..420_000).contains(&once), "{once}");
        assert_eq!(trip.timeout(2).micros(), 2 * once);
        assert_eq!(trip.timeout(200), Duration(MOST));
    }
}
