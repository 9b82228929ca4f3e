//! The recent measurements, in order of time.

use heapless::Deque;
use ubimap_protocol::time::{Duration, Instant};

/// The last `N` entries of one kind with their times, oldest first. They may span at most
/// [`HISTORY_SPAN`].
#[derive(Debug)]
pub(super) struct History<T, const N: usize> {
    /// The entries, each with the lower word of its time in microseconds.
    entries: Deque<(u32, T), N>,
    newest: Instant,
}

/// Half an hour: the lower words of the times are unique within it. Older entries must be dropped
/// before a new one is added.
pub(super) const HISTORY_SPAN: Duration = Duration::from_secs(30 * 60);

impl<T: Copy, const N: usize> History<T, N> {
    pub(super) fn new() -> Self {
        Self { entries: Deque::new(), newest: Instant(0) }
    }

    /// Inserts an entry in order of time, after entries of the same time. Returns `false` if the
    /// history is full.
    pub(super) fn insert(&mut self, moment: Instant, entry: T) -> bool {
        let newest = if self.entries.is_empty() { moment } else { self.newest.max(moment) };
        if self.entries.push_back((moment.0 as u32, entry)).is_err() {
            return false;
        }
        self.newest = newest;
        // Insertion sort from the end, because an entry is usually the newest.
        let age = |entry: &(u32, T)| (newest.0 as u32).wrapping_sub(entry.0);
        let mut entries = self.entries.iter_mut().rev();
        let mut new = entries.next();
        for earlier in entries {
            let Some(later) = new.filter(|later| age(earlier) < age(later)) else { break };
            core::mem::swap(earlier, later);
            new = Some(earlier);
        }
        true
    }

    /// Replaces the newest entry; the new one must not be older than the entry before it.
    pub(super) fn replace_newest(&mut self, moment: Instant, entry: T) {
        if let Some(newest) = self.entries.back_mut() {
            *newest = (moment.0 as u32, entry);
            self.newest = moment;
        }
    }

    /// Drops the entries up to and including a time.
    pub(super) fn forget_until(&mut self, moment: Instant) {
        while self.oldest().is_some_and(|(oldest, _)| oldest <= moment) {
            self.entries.pop_front();
        }
    }

    pub(super) fn is_full(&self) -> bool {
        self.entries.is_full()
    }

    pub(super) fn oldest(&self) -> Option<(Instant, T)> {
        self.iter().next().map(|(moment, entry)| (moment, *entry))
    }

    pub(super) fn newest(&self) -> Option<(Instant, T)> {
        self.iter().next_back().map(|(moment, entry)| (moment, *entry))
    }

    pub(super) fn iter(&self) -> impl DoubleEndedIterator<Item = (Instant, &T)> {
        let newest = self.newest.0;
        self.entries.iter().map(move |(moment, entry)| {
            let age = (newest as u32).wrapping_sub(*moment);
            (Instant(newest.wrapping_sub(age.into())), entry)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn late_entries_are_inserted_in_order_and_the_oldest_dropped() {
        let mut history = History::<char, 4>::new();
        for (moment, entry) in [(50, 'c'), (10, 'a'), (30, 'b'), (50, 'd')] {
            assert!(history.insert(Instant(moment), entry));
        }
        assert!(!history.insert(Instant(40), 'x'));
        let all = |history: &History<char, 4>| {
            history.iter().map(|(_, entry)| *entry).collect::<std::string::String>()
        };
        assert_eq!(all(&history), "abcd");
        history.replace_newest(Instant(60), 'e');
        history.forget_until(Instant(10));
        assert_eq!(all(&history), "bce");
        assert_eq!(history.oldest(), Some((Instant(30), 'b')));
        assert_eq!(history.newest(), Some((Instant(60), 'e')));
    }

    #[test]
    fn times_are_distinct_wherever_their_lower_words_wrap() {
        for wrap in [1u64 << 32, 5 << 32] {
            let mut history = History::<char, 4>::new();
            let at = |millis: i64| Instant(wrap.wrapping_add_signed(millis * 1_000));
            let half_an_hour = HISTORY_SPAN.micros() as i64 / 1_000;
            for (millis, entry) in [(40, 'b'), (half_an_hour - 10, 'd'), (-10, 'a'), (60, 'c')] {
                assert!(history.insert(at(millis), entry));
            }
            let all: std::vec::Vec<_> = history.iter().map(|(at, entry)| (at, *entry)).collect();
            let expected = [(-10, 'a'), (40, 'b'), (60, 'c'), (half_an_hour - 10, 'd')];
            assert_eq!(all, expected.map(|(millis, entry)| (at(millis), entry)));
            history.forget_until(at(59));
            assert_eq!(history.oldest(), Some((at(60), 'c')));
        }
    }
}
