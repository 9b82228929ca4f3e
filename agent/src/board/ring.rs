//! A byte queue between the main loop and an interrupt.

use core::sync::atomic::{AtomicU8, AtomicUsize, Ordering};

/// A byte queue between the main loop and an interrupt: one side puts bytes, the other takes them.
pub(super) struct Ring<const N: usize> {
    bytes: [AtomicU8; N],
    /// Total numbers of bytes put and taken; both wrap.
    put: AtomicUsize,
    taken: AtomicUsize,
}

impl<const N: usize> Ring<N> {
    pub(super) const fn new() -> Self {
        // The counters must wrap at a multiple of the size.
        assert!(N.is_power_of_two());
        Self {
            bytes: [const { AtomicU8::new(0) }; N],
            put: AtomicUsize::new(0),
            taken: AtomicUsize::new(0),
        }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.room() == N
    }

    pub(super) fn room(&self) -> usize {
        let (put, taken) = (self.put.load(Ordering::Acquire), self.taken.load(Ordering::Acquire));
        N - put.wrapping_sub(taken).min(N)
    }

    /// Puts a byte; `false` if the queue is full.
    pub(super) fn put(&self, byte: u8) -> bool {
        let put = self.put.load(Ordering::Relaxed);
        if self.room() == 0 {
            return false;
        }
        self.bytes[put % N].store(byte, Ordering::Relaxed);
        self.put.store(put.wrapping_add(1), Ordering::Release);
        true
    }

    /// Takes the oldest byte.
    pub(super) fn take(&self) -> Option<u8> {
        let taken = self.taken.load(Ordering::Relaxed);
        if self.is_empty() {
            return None;
        }
        let byte = self.bytes[taken % N].load(Ordering::Relaxed);
        self.taken.store(taken.wrapping_add(1), Ordering::Release);
        Some(byte)
    }
}
