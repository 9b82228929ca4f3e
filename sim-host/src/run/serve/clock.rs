//! The clock of a server with cameras: real time since its start, or recorded time, which may pass faster.

use std::time;

use ubimap_protocol::time::Instant;

/// A clock that starts at zero. Robots need one of real time, a speed of 1.
#[derive(Clone, Copy, Debug)]
pub(super) struct Clock {
    began: time::Instant,
    speed: f64,
}

impl Clock {
    /// A clock that starts now.
    pub(super) fn new(speed: f64) -> Self {
        Self { began: time::Instant::now(), speed }
    }

    /// The present time.
    pub(super) fn now(&self) -> Instant {
        self.at(time::Instant::now())
    }

    /// A moment by this clock; zero before its start.
    pub(super) fn at(&self, moment: time::Instant) -> Instant {
        let micros = moment.saturating_duration_since(self.began).as_micros() as u64;
        // Exact for a speed of 1 and for less than 285 years.
        Instant((micros as f64 * self.speed) as u64)
    }

    /// The real time until this clock has passed `moment`.
    pub(super) fn until(&self, moment: Instant) -> time::Duration {
        let micros = moment.micros().saturating_sub(self.now().micros());
        time::Duration::from_micros((micros as f64 / self.speed).ceil() as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_faster_clock_passes_a_moment_sooner() {
        let clock = Clock { began: time::Instant::now(), speed: 50.0 };
        assert_eq!(clock.at(clock.began + time::Duration::from_millis(20)), Instant(1_000_000));
        assert!(clock.until(Instant(2_000_000)) <= time::Duration::from_millis(40));
        std::thread::sleep(clock.until(Instant(2_000_000)));
        assert!(clock.now() >= Instant(2_000_000));
        assert_eq!(clock.until(Instant(2_000_000)), time::Duration::ZERO);
    }
}
