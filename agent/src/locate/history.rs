//! What was said of the last moments, in the order of time.

use heapless::{Deque, deque};
use ubimap_protocol::time::Instant;

/// The last `N` entries of one kind, each with its moment, oldest first.
#[derive(Debug)]
pub(super) struct History<T, const N: usize> {
    entries: Deque<(Instant, T), N>,
}

impl<T: Copy, const N: usize> History<T, N> {
    pub(super) fn new() -> Self {
        Self { entries: Deque::new() }
    }

    /// Adds an entry where it belongs in time: behind those of the same moment. `false` if there
    /// is no room.
    pub(super) fn insert(&mut self, moment: Instant, entry: T) -> bool {
        if self.entries.push_back((moment, entry)).is_err() {
            return false;
        }
        // Sink it to its place: nearly always it is there already.
        let mut entries = self.entries.iter_mut().rev();
        let mut new = entries.next();
        for earlier in entries {
            let Some(later) = new.filter(|later| earlier.0 > later.0) else { break };
            core::mem::swap(earlier, later);
            new = Some(earlier);
        }
        true
    }

    /// Puts another one in the newest one's place; it must not be older than the one before.
    pub(super) fn replace_newest(&mut self, moment: Instant, entry: T) {
        if let Some(newest) = self.entries.back_mut() {
            *newest = (moment, entry);
        }
    }

    /// Forgets those up to a moment.
    pub(super) fn forget_until(&mut self, moment: Instant) {
        while self.entries.front().is_some_and(|(oldest, _)| *oldest <= moment) {
            self.entries.pop_front();
        }
    }

    pub(super) fn is_full(&self) -> bool {
        self.entries.is_full()
    }

    pub(super) fn oldest(&self) -> Option<(Instant, T)> {
        self.entries.front().copied()
    }

    pub(super) fn newest(&self) -> Option<(Instant, T)> {
        self.entries.back().copied()
    }

    pub(super) fn iter(&self) -> deque::Iter<'_, (Instant, T)> {
        self.entries.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn late_entries_find_their_place_and_the_oldest_are_forgotten() {
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
}
