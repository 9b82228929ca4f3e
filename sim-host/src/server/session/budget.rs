//! The downlink budget of one robot.

use std::collections::VecDeque;

use ubimap_protocol::time::{Duration, Instant};

/// Maximum number of bytes in any second.
const BYTES_PER_SECOND: u64 = 2_000;
/// Reserve in bytes for one frame and a few fixes. Messages that can wait are sent only if at least
/// this reserve is left of the budget.
const FRAME: u64 = 400;
/// The period of the budget.
const SECOND: Duration = Duration::from_secs(1);

/// The bytes sent within the last second. Urgent messages count, too, but may exceed the budget.
#[derive(Debug)]
pub(super) struct Budget {
    /// One-time bonus that is left, in bytes; granted when the session begins.
    credit: u64,
    sent: VecDeque<(Instant, u64)>,
}

impl Default for Budget {
    fn default() -> Self {
        Self { credit: BYTES_PER_SECOND, sent: VecDeque::new() }
    }
}

impl Budget {
    /// The earliest time at which another frame is within the budget, if nothing urgent is sent
    /// until then.
    pub(super) fn ready_at(&self) -> Instant {
        let mut left = BYTES_PER_SECOND - FRAME;
        for &(moment, bytes) in self.sent.iter().rev() {
            match left.checked_sub(bytes) {
                Some(rest) => left = rest,
                None => return moment + SECOND,
            }
        }
        Instant(0)
    }

    pub(super) fn spend(&mut self, bytes: u64, now: Instant) {
        while self.sent.front().is_some_and(|&(moment, _)| moment + SECOND <= now) {
            self.sent.pop_front();
        }
        let given = bytes.min(self.credit);
        self.credit -= given;
        self.sent.push_back((now, bytes - given));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_second_after_joining_has_more_than_the_budget() {
        let mut budget = Budget::default();
        budget.spend(BYTES_PER_SECOND, Instant(0));
        let mut frames: Vec<(u64, u64)> = Vec::new();
        for step in 0..2_000 {
            let now = Instant(step * 5_000);
            let bytes = 50 + step * 7_919 % 200;
            if budget.ready_at() <= now {
                budget.spend(bytes, now);
                frames.push((now.0, bytes));
            }
        }
        let within = |from: u64| {
            let second = frames.iter().filter(|(at, _)| (from..from + 1_000_000).contains(at));
            second.map(|(_, bytes)| bytes).sum::<u64>()
        };
        let busiest = frames.iter().map(|&(at, _)| within(at)).max().unwrap();
        let all: u64 = frames.iter().map(|(_, bytes)| bytes).sum();
        assert!(busiest <= BYTES_PER_SECOND, "{busiest}");
        assert!(all >= 10 * (BYTES_PER_SECOND - 2 * FRAME), "{all}");
    }
}
