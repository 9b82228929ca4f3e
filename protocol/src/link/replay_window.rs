//! Which frames of a sealed session were accepted: each counter counts once.

/// Number of counters below the highest one that may still arrive.
const BELOW: u32 = 64;

/// The highest counter accepted, and the ones below it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ReplayWindow {
    /// `None` before the first frame.
    highest: Option<u32>,
    /// Bit `i` stands for counter `highest - 1 - i`.
    below: u64,
}

impl ReplayWindow {
    /// The counter whose low 16 bits are these, and which is nearest to the highest one accepted.
    pub(super) fn whole(&self, low: u16) -> u32 {
        let highest = self.highest.unwrap_or(0);
        let step = low.wrapping_sub(highest as u16) as i16;
        let near = i64::from(highest) + i64::from(step);
        // There are no counters below zero or beyond 32 bits: the next nearest one is meant.
        let beyond = i64::from(near < 0) - i64::from(near > i64::from(u32::MAX));
        (near + (beyond << 16)) as u32
    }

    /// Whether a frame with this counter may still be accepted.
    pub(super) fn is_new(&self, counter: u32) -> bool {
        let Some(highest) = self.highest else { return true };
        match highest.checked_sub(counter) {
            None => true,
            Some(0) => false,
            Some(behind) => behind <= BELOW && self.below >> (behind - 1) & 1 == 0,
        }
    }

    /// Accepts a counter that is new.
    pub(super) fn accept(&mut self, counter: u32) {
        let Some(highest) = self.highest else {
            self.highest = Some(counter);
            return;
        };
        if let Some(behind @ 1..=BELOW) = highest.checked_sub(counter) {
            self.below |= 1 << (behind - 1);
        } else if let Some(ahead @ 1..) = counter.checked_sub(highest) {
            let moved = self.below.checked_shl(ahead).unwrap_or(0);
            // The former highest one is now `ahead` behind.
            self.below = moved | 1u64.checked_shl(ahead - 1).unwrap_or(0);
            self.highest = Some(counter);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    proptest! {
        /// Compared with a set of all counters accepted so far.
        #[test]
        fn every_counter_counts_once_and_late_ones_not_at_all(
            start in prop_oneof![Just(0u32), 0..200_000u32, Just(u32::MAX - 300)],
            steps in proptest::collection::vec(prop_oneof![0..200u32, 0..70u32, Just(0)], 1..300),
        ) {
            let mut window = ReplayWindow::default();
            let mut accepted = BTreeSet::new();
            for step in steps {
                let counter = start.saturating_add(step);
                let late = accepted.last().is_some_and(|highest: &u32| highest - counter.min(*highest) > 64);
                let is_new = !accepted.contains(&counter) && !late;
                prop_assert_eq!(window.is_new(counter), is_new, "{} of {:?}", counter, window);
                if is_new {
                    window.accept(counter);
                    accepted.insert(counter);
                }
            }
        }

        #[test]
        fn a_counter_is_known_by_its_low_half_within_half_a_turn(
            highest in any::<u32>(), step in -32_768..32_768i64,
        ) {
            let window = ReplayWindow { highest: Some(highest), below: 0 };
            let counter = i64::from(highest) + step;
            prop_assume!((0..1 << 32).contains(&counter));
            prop_assert_eq!(window.whole(counter as u16), counter as u32);
        }
    }

    #[test]
    fn the_first_counters_and_the_last_ones_stay_in_range() {
        assert_eq!(ReplayWindow::default().whole(40_000), 40_000);
        let window = |highest| ReplayWindow { highest: Some(highest), below: 0 };
        assert_eq!(window(5).whole(0xFFFF), 0xFFFF);
        assert_eq!(window(70_000).whole(0xFFFF), 0xFFFF);
        assert_eq!(window(u32::MAX - 2).whole(3), u32::MAX - 0xFFFC);
    }
}
