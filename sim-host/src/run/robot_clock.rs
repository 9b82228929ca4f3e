//! The clock of a simulated robot.

use ubimap_protocol::{time::Instant, units::RobotId};

/// A robot's clock, with a random offset and drift.
#[derive(Clone, Copy, Debug)]
pub(super) struct RobotClock {
    start: u64,
    ppm: i64,
}

impl RobotClock {
    /// A clock with an offset of up to ten minutes and a drift of up to 40 ppm either way.
    pub(super) fn of(robot: RobotId, seed: u64) -> Self {
        // SplitMix64's mixing step, so that robots with similar numbers have different clocks.
        let mixed = (seed ^ u64::from(robot.0) << 32).wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (mixed ^ mixed >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = mixed ^ mixed >> 27;
        Self { start: mixed % 600_000_000, ppm: (mixed >> 32) as i64 % 81 - 40 }
    }

    /// The same for a robot that boots when the run begins: its clock has no offset.
    pub(super) fn from_boot(robot: RobotId, seed: u64) -> Self {
        Self { start: 0, ..Self::of(robot, seed) }
    }

    /// What it shows at a time of the server.
    pub(super) fn local(self, server: Instant) -> Instant {
        let drift = server.0 as i64 * self.ppm / 1_000_000;
        Instant(self.start.wrapping_add(server.0).wrapping_add(drift as u64))
    }

    /// The earliest server time at which this clock shows `local` or later.
    pub(super) fn server(self, local: Instant) -> Instant {
        if local.0 == u64::MAX {
            return local;
        }
        let elapsed = local.0.saturating_sub(self.start);
        let scaled = i128::from(elapsed) * 1_000_000 / i128::from(1_000_000 + self.ppm);
        let mut server = Instant((scaled as u64).saturating_sub(2));
        while self.local(server) < local {
            server.0 += 1;
        }
        server
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clock_conversion_finds_the_first_moment_that_shows_a_local_time() {
        for id in 0..50 {
            let clock = RobotClock::of(RobotId(id), 7);
            for server in [0, 1, 999, 1_000_000, 3_600_000_000] {
                let local = clock.local(Instant(server));
                let back = clock.server(local);
                assert!(clock.local(back) >= local && back.0 <= server);
                assert!(back.0 == 0 || clock.local(Instant(back.0 - 1)) < local, "not the first");
            }
        }
    }

    #[test]
    fn clock_drifts_are_symmetric() {
        let clocks: Vec<_> = (0..2_000).map(|id| RobotClock::of(RobotId(id), 7)).collect();
        let hour = 3_600_000_000;
        let gained =
            |clock: &RobotClock| clock.local(Instant(hour)).0 as i64 - (clock.start + hour) as i64;
        let gained: Vec<i64> = clocks.iter().map(gained).collect();
        // 40 ppm of an hour are 144 ms.
        assert_eq!((gained.iter().max(), gained.iter().min()), (Some(&144_000), Some(&-144_000)));
        let [fast, slow] =
            [1, -1].map(|sign| gained.iter().filter(|it| it.signum() == sign).count());
        assert!(fast.abs_diff(slow) < 150 && fast + slow > 1_950, "{fast} fast, {slow} slow");
    }
}
