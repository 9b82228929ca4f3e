//! Stops the robot for each scan, so that its pose is measured where it stands (Ahmed 3: "after
//! every move, the robots needed to wait so that the tracking system locks their current
//! position").

use ubimap_protocol::{time::Instant, units::Pose};

use crate::{map::Gate, timing::UNSEEN_STOP};

/// Drives from scan to scan.
#[derive(Clone, Copy, Debug)]
pub struct Stops {
    phase: Phase,
    /// Whether a fix has arrived since the robot last moved.
    is_located: bool,
}

/// The phases of a stop. Poses are `base_link` in `odom`.
#[derive(Clone, Copy, Debug)]
enum Phase {
    /// The robot has not started yet.
    New,
    /// Driving; the pose at which the robot set out, once known.
    Driving(Option<Pose>),
    /// Commanded to stand, but still moving; the pose is that of the last step.
    Stopping(Pose),
    /// Standing since this time.
    Standing(Instant),
}

impl Default for Stops {
    /// Stands until the first scan is mapped, or until the stop has lasted too long.
    fn default() -> Self {
        Self { phase: Phase::New, is_located: false }
    }
}

impl Stops {
    /// Whether the wheels must stand. Call at every step with the newest odometry. The robot drives
    /// from one stop until `gate` opens, then stops again.
    pub fn must_stand(&mut self, gate: Gate, odometry: Option<Pose>, now: Instant) -> bool {
        let Some(odometry) = odometry else { return true };
        if let Phase::Driving(Some(from)) = self.phase {
            self.is_located &= from == odometry;
        }
        self.phase = match self.phase {
            Phase::New => Phase::Standing(now),
            Phase::Driving(None) => Phase::Driving(Some(odometry)),
            Phase::Driving(from) if gate.opens(from, odometry) => Phase::Stopping(odometry),
            Phase::Stopping(before) if before == odometry => Phase::Standing(now),
            Phase::Stopping(_) => Phase::Stopping(odometry),
            Phase::Standing(since) if now.since(since) >= UNSEEN_STOP => {
                Phase::Driving(Some(odometry))
            }
            phase => phase,
        };
        !matches!(self.phase, Phase::Driving(_))
    }

    /// Whether to map a scan taken at `taken`: only if the robot stands, and its newest fix (at
    /// `fix`) was taken after it stopped. If so, the robot may drive on.
    pub fn takes(&mut self, taken: Instant, fix: Option<Instant>) -> bool {
        if let Phase::Standing(since) = self.phase {
            self.is_located = taken >= since && fix.is_some_and(|fix| fix >= since);
            if self.is_located {
                self.phase = Phase::Driving(None);
            }
        }
        self.is_located
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant(millis * 1_000)
    }

    #[test]
    fn it_maps_where_it_stands_and_has_been_localised_since() {
        let mut stops = Stops::default();
        let must_stand = |stops: &mut Stops, x, now| {
            stops.must_stand(Gate::default(), Some(Pose::from_metres(x, 0.0, 0.0)), now)
        };
        let unknown = stops.must_stand(Gate::default(), None, at(0));
        assert!(unknown, "without odometry it may have moved");
        assert!(must_stand(&mut stops, 0.0, at(20)), "the first scan is taken where it stands");
        assert!(stops.takes(at(30), Some(at(25))));
        assert!(!must_stand(&mut stops, 0.0, at(50)));
        assert!(!must_stand(&mut stops, 0.035, at(100)));
        assert!(!stops.takes(at(100), Some(at(100))), "it drives");
        assert!(must_stand(&mut stops, 0.036, at(150)));
        assert!(must_stand(&mut stops, 0.05, at(200)), "it brakes");
        assert!(!stops.takes(at(210), Some(at(210))));
        assert!(must_stand(&mut stops, 0.05, at(250)));
        assert!(!stops.takes(at(260), Some(at(249))), "the fix is from while it drove");
        assert!(!stops.takes(at(249), Some(at(260))), "the scan is from while it drove");
        assert!(stops.takes(at(300), Some(at(260))));
        assert!(!must_stand(&mut stops, 0.05, at(350)), "the gate starts from here");
        assert!(stops.takes(at(360), Some(at(360))), "while it stands");
        assert!(!must_stand(&mut stops, 0.08, at(400)));
        assert!(!stops.takes(at(410), Some(at(410))), "it drives");
        // While no fix arrives, the robot keeps standing.
        assert!(must_stand(&mut stops, 0.09, at(450)) && must_stand(&mut stops, 0.09, at(500)));
        assert!(must_stand(&mut stops, 0.09, at(3_499)));
        assert!(!must_stand(&mut stops, 0.09, at(3_500)));
    }
}
