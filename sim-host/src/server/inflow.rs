//! How much is read of what comes in at a port.

use ubimap_protocol::time::{Duration, Instant};

/// A byte takes so long: 40 kB a second, several times what the serial links of robots carry.
const BYTE: Duration = Duration::from_micros(25);
/// So much may come at once: 80 kB.
const BURST: Duration = Duration::from_secs(2);

/// Bytes beyond the measure are lost, as on a bad link: work and memory for one port are bounded,
/// and the others come to their turn.
#[derive(Debug, Default)]
pub(super) struct Inflow {
    /// When what has come in would have come in byte by byte.
    busy_until: Instant,
    floods: bool,
}

impl Inflow {
    /// How many of so many bytes are read.
    pub(super) fn admit(&mut self, bytes: usize, now: Instant) -> usize {
        // Further ahead it can only be because the clock has been set back.
        let is_ahead = now < self.busy_until && self.busy_until <= now + BURST;
        let begin = if is_ahead { self.busy_until } else { now };
        self.floods &= begin > now;
        let room = (now + BURST).since(begin).micros() / BYTE.micros();
        let admitted = room.min(bytes as u64);
        self.busy_until = begin + Duration(admitted * BYTE.micros());
        self.floods |= admitted < bytes as u64;
        // No more than there are.
        admitted as usize
    }

    /// Whether more comes in than is read.
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
