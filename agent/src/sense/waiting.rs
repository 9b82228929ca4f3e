//! Scans that wait for the pose of the moment they were taken.

use heapless::Deque;
use ubimap_protocol::time::Instant;

/// The most scans that can wait, whatever memory there is.
const MOST: usize = 8;

/// Why a scan was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScanError {
    /// It has another number of readings than the sensor was configured with.
    Width {
        /// Readings that a scan must have.
        expected: usize,
        /// Readings that it had.
        found: usize,
    },
    /// As many scans as there is room for wait for their poses already.
    Full,
    /// It was taken before the scan that came before it.
    Backwards,
}

/// The scans that wait, oldest first, in the caller's memory, which they take in turns.
#[derive(Debug)]
pub struct WaitingScans<'b> {
    readings: &'b mut [u16],
    width: usize,
    slots: usize,
    /// The slot of the oldest.
    first: usize,
    taken: Deque<Instant, MOST>,
    newest: Instant,
}

impl<'b> WaitingScans<'b> {
    /// Room for as many scans of `width` readings as `readings` holds, at most 8.
    pub fn new(readings: &'b mut [u16], width: usize) -> Self {
        let slots = (readings.len() / width.max(1)).min(MOST);
        Self { readings, width, slots, first: 0, taken: Deque::new(), newest: Instant(0) }
    }

    /// Whether a scan could be one of this sensor's: apart from there being room.
    ///
    /// # Errors
    /// Every [`ScanError`] but [`ScanError::Full`].
    pub fn check(&self, taken: Instant, readings: &[u16]) -> Result<(), ScanError> {
        if readings.len() != self.width {
            return Err(ScanError::Width { expected: self.width, found: readings.len() });
        }
        if taken < self.newest {
            return Err(ScanError::Backwards);
        }
        Ok(())
    }

    /// Takes a scan: its readings in millimetres (0: no return) and the moment it was taken.
    ///
    /// # Errors
    /// Every [`ScanError`]; nothing has changed then.
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

    /// Takes the oldest scan out. Its readings stand until the next one is pushed.
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

/// Copies as many readings, in half the instructions of the plain copy of a program built to be small.
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
