//! The clock of a machine that sends camera frames, compared with ours.

use ubimap_protocol::time::{Duration, Instant};

/// Difference beyond which the sender's clock has been set, rather than a frame been delayed.
const JUMP_MICROS: i64 = 1_000_000;
/// Number of frames in a row that must be late by more than that.
const LATE_FRAMES: u32 = 5;
/// Time for which the quickest frame counts, so that drift is followed: 100 ppm of it are 3 ms.
const WINDOW: Duration = Duration::from_secs(30);

/// Estimates the offset of a sender's clock from the quickest of its recent frames: the true offset plus
/// the shortest time on the way, which is below a millisecond within a machine and a few on a network.
#[derive(Clone, Copy, Debug, Default)]
pub struct SenderClock {
    /// The smallest differences (our time of arrival minus the sender's time of sending), in
    /// microseconds, in the present window and in the one before.
    least: Option<[i64; 2]>,
    window_ends: Instant,
    late: u32,
    least_late: i64,
    jumps: u32,
}

impl SenderClock {
    /// Takes the time of sending of a frame in microseconds of the sender's clock, and its arrival.
    /// Returns whether the sender's clock has been set.
    pub fn heard(&mut self, sent: u64, arrived: Instant) -> bool {
        let difference = (arrived.micros() as i64).wrapping_sub(sent as i64);
        let Some(offset) = self.offset_micros() else {
            self.begin(difference, arrived);
            return false;
        };
        let late = difference.saturating_sub(offset);
        if late > JUMP_MICROS {
            let least_late = if self.late == 0 { difference } else { self.least_late };
            self.least_late = least_late.min(difference);
            self.late += 1;
            if self.late < LATE_FRAMES {
                return false;
            }
        }
        if late.abs() > JUMP_MICROS {
            let begin = if late > 0 { self.least_late } else { difference };
            self.begin(begin, arrived);
            self.jumps += 1;
            return true;
        }
        self.late = 0;
        let [current, previous] = self.least.unwrap_or([difference; 2]);
        self.least = Some(if arrived >= self.window_ends {
            self.window_ends = arrived + WINDOW;
            [difference, current]
        } else {
            [current.min(difference), previous]
        });
        false
    }

    fn begin(&mut self, difference: i64, arrived: Instant) {
        self.least = Some([difference; 2]);
        self.window_ends = arrived + WINDOW;
        self.late = 0;
    }

    /// Our clock minus the sender's, in microseconds. `None` before the first frame.
    pub fn offset_micros(&self) -> Option<i64> {
        self.least.map(|[current, previous]| current.min(previous))
    }

    /// Number of times that the sender's clock has been set.
    pub fn jumps(&self) -> u32 {
        self.jumps
    }

    /// Converts a time of the sender's clock, in microseconds, to ours.
    pub fn ours(&self, sender: u64) -> Instant {
        let offset = self.offset_micros().unwrap_or_default();
        Instant((sender as i64).wrapping_add(offset).max(0) as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames at 15 Hz for some seconds, sent by a clock that is ahead of ours and reached us after a
    /// delay. Returns the number of jumps reported.
    fn frames(
        clock: &mut SenderClock,
        (from_s, to_s): (u64, u64),
        ahead: i64,
        delay: impl Fn(u64) -> u64,
    ) -> u32 {
        let jumps = (from_s * 15..to_s * 15).filter(|frame| {
            let ours = frame * 66_667;
            let arrived = Instant(ours + delay(*frame));
            clock.heard((ours as i64 + ahead) as u64, arrived)
        });
        jumps.count() as u32
    }

    #[test]
    fn the_offset_is_that_of_the_quickest_frame() {
        let mut clock = SenderClock::default();
        let day = 86_400_000_000;
        assert_eq!(frames(&mut clock, (1, 20), day, |frame| 300 + frame * 7_919 % 40_000), 0);
        let offset = clock.offset_micros().unwrap() + day;
        assert!((300..2_000).contains(&offset), "{offset}");
        let captured = clock.ours(day as u64 + 5_000_000).micros() as i64;
        assert!((captured - 5_000_000 - offset).abs() < 2);
    }

    #[test]
    fn jumps_both_ways_are_followed_and_drift_too() {
        let mut clock = SenderClock::default();
        let hour = 3_600_000_000;
        frames(&mut clock, (1, 10), hour, |_| 500);
        for (from_s, ahead) in [(10, 2 * hour), (20, 0), (30, 1_500_000)] {
            assert_eq!(frames(&mut clock, (from_s, from_s + 10), ahead, |_| 500), 1);
            assert_eq!(clock.offset_micros(), Some(500 - ahead));
        }
        // A clock that is 100 ppm slow loses 12 ms in two minutes.
        let slow = |frame: u64| 500 + (frame - 40 * 15) * 66_667 / 10_000;
        assert_eq!(frames(&mut clock, (40, 160), 1_500_000, slow), 0);
        let behind = 12_500 - (clock.offset_micros().unwrap() + 1_500_000);
        assert!((0..6_500).contains(&behind), "{behind}");
        assert_eq!(clock.jumps(), 3);
    }

    #[test]
    fn a_few_late_frames_are_no_jump() {
        let mut clock = SenderClock::default();
        let stall = |frame: u64| if frame.is_multiple_of(20) { 3_000_000 } else { 500 };
        assert_eq!(frames(&mut clock, (1, 20), 0, stall), 0);
        assert_eq!(clock.offset_micros(), Some(500));
    }
}
