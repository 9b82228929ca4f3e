//! When frames were sent that a device sends at regular intervals.

use ubimap_protocol::time::Instant;

/// The regularity of a device's frames, in microseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Regularity {
    /// Interval between two frames, at most a minute.
    pub(super) interval: u32,
    /// Deviations from it within this are the device's own, in both directions, and are averaged.
    pub(super) jitter: u32,
    /// Maximum error of the interval.
    pub(super) error: u32,
}

/// A frame that is this late, in microseconds, is the first one after a pause of the device.
const PAUSE: i32 = 250_000;
/// Maximum number of frames lost in a row, and one.
const MAX_COUNT: u16 = 10;
/// Fraction of a deviation within the jitter by which the next frames are expected later or earlier.
const GAIN: i32 = 8;

/// Estimates the moments of a device's frames. A frame that waited somewhere arrives late, never early, so
/// that earlier frames tell when it was sent.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cadence {
    newest: Instant,
}

impl Cadence {
    /// Before the first frame.
    pub(super) const NEW: Self = Self { newest: Instant(u64::MAX / 2) };

    /// The moment of a frame that arrived at `arrived`, and is the `count`th since the last one; with a count
    /// that can't be, as 0, a new series begins. After frames that were lost and not counted, moments are too
    /// early by their intervals at first, and right again after as many errors of an interval.
    #[inline(never)]
    pub(super) fn moment(&mut self, arrived: Instant, count: u16, device: &Regularity) -> Instant {
        let due = device.interval.wrapping_mul(count.into());
        let late = arrived.0.wrapping_sub(self.newest.0).wrapping_sub(due.into()) as i64;
        let correction = match i32::try_from(late) {
            Ok(late) if (1..=MAX_COUNT).contains(&count) && late < PAUSE => {
                let within = late.unsigned_abs() <= device.jitter;
                late - if within { late / GAIN } else { late.min(device.error as i32) }
            }
            _ => 0,
        };
        self.newest = Instant(arrived.0.wrapping_sub(correction as i64 as u64));
        self.newest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const CAMERA: Regularity = Regularity { interval: 100_000, jitter: 20_000, error: 6_000 };

    /// Maximum error in microseconds from the 50th frame on, of a camera whose interval is off by `off_micros`;
    /// `late` is by how much each frame arrives late, or early.
    fn most(off_micros: i64, late: impl Fn(u64) -> i64) -> u64 {
        let mut cadence = Cadence::NEW;
        let mut read = 0;
        (0..400_u64)
            .map(|frame| {
                let sent =
                    (1_000_000 + frame * 100_000).saturating_add_signed(frame as i64 * off_micros);
                // Bytes are read in order.
                read = read.max(sent.saturating_add_signed(late(frame)));
                let moment = cadence.moment(Instant(read), 1, &CAMERA);
                if frame < 50 { 0 } else { moment.0.abs_diff(sent) }
            })
            .fold(0, u64::max)
    }

    #[test]
    fn the_moments_of_a_slow_camera_and_a_quick_one_are_followed() {
        assert_eq!(most(0, |_| 0), 0);
        for off in [-5_000, -1_000, 1_000, 5_000] {
            assert!(most(off, |_| 0) <= 21_000, "{off}: {}", most(off, |_| 0));
        }
    }

    #[test]
    fn a_pause_begins_anew() {
        let mut cadence = Cadence::NEW;
        cadence.moment(Instant(1_000_000), 1, &CAMERA);
        assert_eq!(cadence.moment(Instant(1_350_000), 1, &CAMERA), Instant(1_350_000));
        // Two frames were lost, and counted.
        assert_eq!(cadence.moment(Instant(1_650_000), 3, &CAMERA), Instant(1_650_000));
        // The clock of a robot never goes back; if it did, nothing would break.
        assert_eq!(cadence.moment(Instant(5), 1, &CAMERA), Instant(5));
        // Numbers begin anew.
        assert_eq!(cadence.moment(Instant(9), 0, &CAMERA), Instant(9));
        assert_eq!(cadence.moment(Instant(7), u16::MAX, &CAMERA), Instant(7));
    }

    proptest! {
        /// Its own jitter is averaged. Every 20th frame is read up to 0.2 s late, as are those behind it: each
        /// late frame adds the error of an interval.
        #[test]
        fn frames_that_waited_have_the_moments_at_which_they_were_sent(
            jitter in prop::collection::vec(-10_000i64..10_000, 400),
            stalls in prop::collection::vec(0i64..200_000, 20),
        ) {
            let late = |frame: u64| {
                let stalled = if frame.is_multiple_of(20) { stalls[frame as usize / 20] } else { 0 };
                jitter[frame as usize] + stalled
            };
            prop_assert!(most(0, |frame| jitter[frame as usize]) <= 7_000);
            prop_assert!(most(0, late) <= 25_000, "{}", most(0, late));
        }
    }
}
