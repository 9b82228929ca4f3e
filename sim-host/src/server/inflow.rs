//! A rate limit for the bytes read from a port.

use ubimap_protocol::time::{Duration, Instant};

/// Time charged for each byte: 40 kB/s, several times the rate of robots' serial links.
const BYTE: Duration = Duration::from_micros(25);
/// Maximum charge: a burst of 80 kB.
const BURST: Duration = Duration::from_secs(2);

/// A leaky bucket. Excess bytes are dropped, as on a bad link. This bounds the work and memory that
/// one port can claim.
#[derive(Debug, Default)]
pub(super) struct Inflow {
    /// The time at which the bucket is empty.
    busy_until: Instant,
    floods: bool,
}

impl Inflow {
    /// Returns how many of the received bytes may be read.
    pub(super) fn admit(&mut self, bytes: usize, now: Instant) -> usize {
        // It can only be further ahead if the clock was set back.
        let is_ahead = now < self.busy_until && self.busy_until <= now + BURST;
        let begin = if is_ahead { self.busy_until } else { now };
        self.floods &= begin > now;
        let room = (now + BURST).since(begin).micros() / BYTE.micros();
        let admitted = room.min(bytes as u64);
        self.busy_until = begin + Duration(admitted * BYTE.micros());
        self.floods |= admitted < bytes as u64;
        // At most `bytes`, so the cast is lossless.
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
    fn excess_bytes_are_dropped_until_the_charge_is_used_up() {
        let mut inflow = Inflow::default();
        let at = |millis: u64| Instant(5_000_000 + millis * 1_000);
        assert_eq!(inflow.admit(80_000, at(0)), 80_000);
        assert!(!inflow.floods());
        assert_eq!(inflow.admit(50, at(1)), 40);
        assert!(inflow.floods());
        let admitted: usize = (2..1_000).map(|millis| inflow.admit(1_000, at(millis))).sum();
        assert_eq!(admitted, 998 * 40);
        assert_eq!(inflow.admit(1, at(2_999)), 1);
        assert!(!inflow.floods(), "the flood is over");
        inflow.admit(80_000, at(3_000));
        assert_eq!(inflow.admit(80_000, Instant(0)), 80_000);
        assert_eq!(inflow.admit(80_000, Instant(1_000_000)), 40_000, "the clock was set back");
    }
}
