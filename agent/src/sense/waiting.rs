//! Scans that wait for their poses.

use core::fmt;

use heapless::Deque;
use ubimap_protocol::time::Instant;

/// Maximum number of waiting scans, however much memory there is.
const MAX_WAITING: usize = 8;

/// Why a scan was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScanError {
    /// The number of readings differs from the configured sensor.
    Width {
        /// Number of readings required.
        expected: usize,
        /// Number of readings received.
        found: usize,
    },
    /// The queue is full: too many scans wait for their poses.
    Full,
    /// The scan was taken before the previous one.
    Backwards,
}

impl fmt::Display for ScanError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Width { expected, found } => {
                write!(f, "the scan has {found} readings instead of {expected}")
            }
            Self::Full => f.write_str("too many scans wait for their poses"),
            Self::Backwards => f.write_str("the scan is older than the previous one"),
        }
    }
}

impl core::error::Error for ScanError {}

/// The waiting scans, oldest first, in a ring buffer in the caller's memory.
#[derive(Debug)]
pub struct WaitingScans<'b> {
    readings: &'b mut [u16],
    width: usize,
    slots: usize,
    /// The slot of the oldest scan.
    first: usize,
    taken: Deque<Instant, MAX_WAITING>,
    newest: Instant,
}

impl<'b> WaitingScans<'b> {
    /// A queue for scans of `width` readings: as many as fit into `readings`, at most 8.
    pub fn new(readings: &'b mut [u16], width: usize) -> Self {
        let slots = (readings.len() / width.max(1)).min(MAX_WAITING);
        Self { readings, width, slots, first: 0, taken: Deque::new(), newest: Instant(0) }
    }

    /// Checks a scan, but not whether the queue is full.
    ///
    /// # Errors
    /// Every [`ScanError`] except [`ScanError::Full`].
    pub fn check(&self, taken: Instant, readings: &[u16]) -> Result<(), ScanError> {
        if readings.len() != self.width {
            return Err(ScanError::Width { expected: self.width, found: readings.len() });
        }
        if taken < self.newest {
            return Err(ScanError::Backwards);
        }
        Ok(())
    }

    /// Adds a scan: its readings in millimetres (0: no return) and the time it was taken.
    ///
    /// # Errors
    /// [`ScanError`]; the queue is unchanged.
    pub fn push(&mut self, taken: Instant, readings: &[u16]) -> Result<(), ScanError> {
        self.check(taken, readings)?;
        if self.taken.len() >= self.slots {
            return Err(ScanError::Full);
        }
        let free = self.first + self.taken.len();
        let free = if free < self.slots { free } else { free - self.slots };
        copy(self.slot(free).ok_or(ScanError::Full)?, readings);
        self.taken.push_back(taken).map_err(|_| ScanError::Full)?;
        self.newest = taken;
        Ok(())
    }

    /// When the oldest scan was taken.
    pub fn oldest(&self) -> Option<Instant> {
        self.taken.front().copied()
    }

    /// Removes the oldest scan. Its readings are kept until the next push.
    pub fn pop(&mut self) -> Option<&mut [u16]> {
        self.taken.pop_front()?;
        let slot = self.first;
        self.first = if slot + 1 < self.slots { slot + 1 } else { 0 };
        self.slot(slot)
    }

    fn slot(&mut self, slot: usize) -> Option<&mut [u16]> {
        let start = slot * self.width;
        self.readings.get_mut(start..start + self.width)
    }
}

/// Copies readings, four at a time: half the instructions of `copy_from_slice` at opt-level "s".
fn copy(to: &mut [u16], from: &[u16]) {
    let ((to, to_rest), (from, rest)) = (to.as_chunks_mut::<4>(), from.as_chunks::<4>());
    let ((to, to_fours), (from, fours)) = (to.as_chunks_mut::<4>(), from.as_chunks::<4>());
    for ([to_a, to_b, to_c, to_d], [a, b, c, d]) in to.iter_mut().zip(from) {
        (*to_a, *to_b, *to_c, *to_d) = (*a, *b, *c, *d);
    }
    to_fours.iter_mut().zip(fours).for_each(|(to, from)| *to = *from);
    to_rest.iter_mut().zip(rest).for_each(|(to, from)| *to = *from);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scans_come_out_in_order_and_a_full_queue_refuses() {
        let mut memory = [0u16; 7];
        let mut waiting = WaitingScans::new(&mut memory, 3);
        assert_eq!(waiting.push(Instant(5), &[1, 2, 3]), Ok(()));
        assert_eq!(
            waiting.push(Instant(6), &[1, 2]),
            Err(ScanError::Width { expected: 3, found: 2 })
        );
        assert_eq!(waiting.push(Instant(4), &[4, 5, 6]), Err(ScanError::Backwards));
        assert_eq!(waiting.push(Instant(6), &[4, 5, 6]), Ok(()));
        assert_eq!(waiting.push(Instant(7), &[7, 8, 9]), Err(ScanError::Full));
        assert_eq!((waiting.oldest(), waiting.pop()), (Some(Instant(5)), Some(&mut [1, 2, 3][..])));
        assert_eq!(waiting.push(Instant(7), &[7, 8, 9]), Ok(()));
        assert_eq!(waiting.pop(), Some(&mut [4, 5, 6][..]));
        assert_eq!(waiting.pop(), Some(&mut [7, 8, 9][..]));
        assert_eq!(waiting.pop(), None);
    }
}
