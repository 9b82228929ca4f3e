//! A limit to the bytes that are read from a port.

use ubimap_protocol::time::{Duration, Instant};

/// The time that each byte is charged: 40 kB a second, several times what the serial links of robots
/// carry.
const BYTE: Duration = Duration::from_micros(25);
/// The longest that a port may be charged ahead: a burst of 80 kB.
const BURST: Duration = Duration::from_secs(2);

/// A leaky bucket. Bytes beyond it are dropped, as on a bad link, so that one port can claim only
/// a bounded share of work and memory.
#[derive(Debug, Default)]
pub(super) struct Inflow {
    /// Until when the port is charged.
    busy_until: Instant,
    floods: bool,
}

impl Inflow {
    /// How many of a number of bytes are read.
    pub(super) fn admit(&mut self, bytes: usize, now: Instant) -> usize {
        // It is further ahead only if the clock was set back.
        let is_ahead = now < self.busy_until && self.busy_until <= now + BURST;
        let begin = if is_ahead { self.busy_until } else { now };
        self.floods &= begin > now;
        let room = (now + BURST).since(begin).micros() / BYTE.micros();
        let admitted = room.min(bytes as u64);
        self.busy_until = begin + Duration(admitted * BYTE.micros());
        self.floods |= admitted < bytes as u64;
        // At most `bytes`, so it fits.
        admitted as usize
    }

    /// Whether bytes are being dropped.
    pub(super) fn floods(&self) -> bool {
        self.floods
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_too_much_is_not_read_until_it_has_passed() {
        let mut inflow = Inflow::default();
        let at = |millis: u64| Instant(5_000_000 + millis * 1_000);
        assert_eq!(inflow.admit(80_000, at(0)), 80_000);
        assert!(!inflow.floods());
        assert_eq!(inflow.admit(50, at(1)), 40);
        assert!(inflow.floods());
        let admitted: usize = (2..1_000).map(|millis| inflow.admit(1_000, at(millis))).sum();
        assert_eq!(admitted, 998 * 40);
        assert_eq!(inflow.admit(1, at(2_999)), 1);
        assert!(!inflow.floods(), "it has passed");
        inflow.admit(80_000, at(3_000));
        assert_eq!(inflow.admit(80_000, Instant(0)), 80_000);
        assert_eq!(inflow.admit(80_000, Instant(1_000_000)), 40_000, "a clock that was set back");
    }
}
