//! A serial line: bytes leave at its speed.

use std::collections::VecDeque;

use ubimap_protocol::time::Instant;

/// Bits per byte: start bit, eight data bits, stop bit.
const BITS_PER_BYTE: u64 = 10;

/// Bytes on their way to a robot, each with the moment when it has been sent completely.
#[derive(Clone, Debug)]
pub struct Line {
    /// Time per byte in nanoseconds.
    byte_nanos: u64,
    /// When the line is free, in nanoseconds.
    free: u64,
    bytes: VecDeque<(Instant, u8)>,
}

impl Line {
    /// An idle line of this speed in bits per second.
    pub fn new(baud: u32) -> Self {
        let byte_nanos = BITS_PER_BYTE * 1_000_000_000 / u64::from(baud.max(1));
        Self { byte_nanos, free: 0, bytes: VecDeque::new() }
    }

    /// Sends bytes from `from` on, after those that are being sent.
    pub fn send(&mut self, bytes: &[u8], from: Instant) {
        for &byte in bytes {
            self.free = self.free.max(from.micros() * 1_000) + self.byte_nanos;
            self.bytes.push_back((Instant(self.free.div_ceil(1_000)), byte));
        }
    }

    /// Whether all bytes have been sent by `at`.
    pub fn is_free(&self, at: Instant) -> bool {
        self.free <= at.micros() * 1_000
    }

    /// When the next byte arrives.
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.bytes.front().map(|&(at, _)| at)
    }

    /// Takes the bytes that have arrived by `now`.
    pub fn poll(&mut self, now: Instant) -> Vec<u8> {
        let arrived = self.bytes.iter().take_while(|(at, _)| *at <= now).count();
        self.bytes.drain(..arrived).map(|(_, byte)| byte).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_arrive_at_the_speed_of_the_line() {
        let mut line = Line::new(115_200);
        line.send(&[7; 1_152], Instant(1_000));
        line.send(&[8], Instant(2_000));
        assert_eq!(line.poll(Instant(1_086)), [0; 0]);
        assert_eq!(line.poll(Instant(1_087)), [7]);
        // A tenth of a second, then the byte that waited.
        assert_eq!(line.poll(Instant(101_000)), [7; 1_151]);
        assert_eq!(line.poll_timeout(), Some(Instant(101_087)));
        assert_eq!(line.poll(Instant(102_000)), [8]);
        assert!(!line.is_free(Instant(101_086)) && line.is_free(Instant(101_087)));
    }
}
