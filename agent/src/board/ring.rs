//! A byte queue between the main loop and an interrupt.

use core::sync::atomic::{AtomicU8, AtomicUsize, Ordering};

/// A byte queue between the main loop and an interrupt: one side puts bytes, the other takes them.
pub(super) struct Ring {
    bytes: &'static [AtomicU8],
    /// Total numbers of bytes put and taken; both wrap.
    put: AtomicUsize,
    taken: AtomicUsize,
}

impl Ring {
    /// An empty queue in memory whose size is a power of two, so that the counters wrap at a
    /// multiple of it.
    pub(super) const fn new(bytes: &'static [AtomicU8]) -> Self {
        assert!(bytes.len().is_power_of_two());
        Self { bytes, put: AtomicUsize::new(0), taken: AtomicUsize::new(0) }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.room() == self.bytes.len()
    }

    /// Number of bytes in it.
    #[cfg(any(feature = "rp2", feature = "in-step"))]
    pub(super) fn len(&self) -> usize {
        self.bytes.len() - self.room()
    }

    pub(super) fn room(&self) -> usize {
        let (put, taken) = (self.put.load(Ordering::Acquire), self.taken.load(Ordering::Acquire));
        self.bytes.len() - put.wrapping_sub(taken).min(self.bytes.len())
    }

    /// Puts a byte; `false` if the queue is full.
    pub(super) fn put(&self, byte: u8) -> bool {
        let put = self.put.load(Ordering::Relaxed);
        if self.room() == 0 {
            return false;
        }
        let Some(place) = self.bytes.get(put & (self.bytes.len() - 1)) else { return false };
        place.store(byte, Ordering::Relaxed);
        self.put.store(put.wrapping_add(1), Ordering::Release);
        true
    }

    /// Takes the oldest byte.
    pub(super) fn take(&self) -> Option<u8> {
        let taken = self.taken.load(Ordering::Relaxed);
        if self.is_empty() {
            return None;
        }
        let byte = self.bytes.get(taken & (self.bytes.len() - 1))?.load(Ordering::Relaxed);
        self.taken.store(taken.wrapping_add(1), Ordering::Release);
        Some(byte)
    }

    /// Copies the oldest bytes, which stay. Returns them.
    #[cfg(feature = "rp2")]
    pub(super) fn copy<'b>(&self, bytes: &'b mut [u8]) -> &'b [u8] {
        let taken = self.taken.load(Ordering::Relaxed);
        let len = self.len().min(bytes.len());
        for (offset, byte) in bytes.iter_mut().take(len).enumerate() {
            let at = taken.wrapping_add(offset) & (self.bytes.len() - 1);
            *byte = self.bytes.get(at).map_or(0, |byte| byte.load(Ordering::Relaxed));
        }
        bytes.get(..len).unwrap_or_default()
    }

    /// Takes the oldest bytes, at most as many as there are.
    #[cfg(feature = "rp2")]
    pub(super) fn skip(&self, count: usize) {
        let count = count.min(self.len());
        let taken = self.taken.load(Ordering::Relaxed);
        self.taken.store(taken.wrapping_add(count), Ordering::Release);
    }
}
