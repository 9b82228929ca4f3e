//! Delivery of camera fixes to one robot.

use ubimap_protocol::{
    message::{Certainty, FixSource, MAX_EARLIER_FIXES, PoseFix, ToRobot, Writer},
    time::{Duration, Instant},
};

use crate::camera::Sighting;

/// Minimum interval between messages with camera fixes, for any number of cameras that see the
/// robot. Each message also carries earlier fixes.
const INTERVAL: Duration = Duration::from_millis(60);

/// Fixes from cameras and from map matches.
#[derive(Debug, Default)]
pub(super) struct Fixes {
    newest_first: Vec<(Instant, Sighting)>,
    /// Whether the newest fix has not been sent.
    is_due: bool,
    next: Instant,
    /// A fix from a match with the map, until it is sent.
    matched: Option<PoseFix>,
}

impl Fixes {
    /// Adds a camera fix, unless it is not newer than the newest one.
    pub(super) fn add(&mut self, moment: Instant, sighting: Sighting) {
        if self.newest_first.first().is_some_and(|&(newest, _)| newest >= moment) {
            return;
        }
        self.newest_first.insert(0, (moment, sighting));
        self.newest_first.truncate(1 + MAX_EARLIER_FIXES);
        self.is_due = true;
    }

    /// Adds a fix from a match with the map.
    pub(super) fn add_matched(&mut self, fix: PoseFix) {
        self.matched = Some(fix);
    }

    /// Whether a fix can be sent now.
    pub(super) fn is_ready(&self, now: Instant) -> bool {
        self.is_camera_fix_ready(now) || self.matched.is_some()
    }

    fn is_camera_fix_ready(&self, now: Instant) -> bool {
        self.is_due && self.next <= now
    }

    /// Adds the ready fixes to a frame.
    pub(super) fn write(&mut self, now: Instant, writer: &mut Writer<'_, ToRobot>) {
        if self.is_camera_fix_ready(now)
            && let Some((newest, earlier)) = self.newest_first.split_first()
        {
            self.next = now + INTERVAL;
            let placed = |&(moment, sighting): &(Instant, Sighting)| (moment, sighting.pose);
            let sent = writer.push_longest(0..=earlier.len(), |count| {
                let certainty = least_certain(&self.newest_first[..=count]);
                let earlier = earlier[..count].iter().map(placed);
                PoseFix::from_fixes(placed(newest), earlier, certainty, FixSource::Camera)
            });
            self.is_due = sent.is_none();
        }
        self.matched.take_if(|fix| writer.push(fix));
    }

    /// When the next fix is due.
    pub(super) fn poll_timeout(&self, now: Instant) -> Option<Instant> {
        if self.matched.is_some() { Some(now) } else { self.is_due.then_some(self.next) }
    }

    /// Number of messages waiting to be sent.
    pub(super) fn waiting(&self) -> usize {
        usize::from(self.is_due) + usize::from(self.matched.is_some())
    }
}

/// For each axis, the certainty of the least certain of several fixes.
fn least_certain(fixes: &[(Instant, Sighting)]) -> Certainty {
    fixes.iter().fold(Certainty::default(), |least, (_, Sighting { certainty, .. })| Certainty {
        x: least.x.max(certainty.x),
        y: least.y.max(certainty.y),
        heading: least.heading.max(certainty.heading),
    })
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::units::{Pose, RobotId};

    use super::*;

    #[test]
    fn the_certainty_of_a_message_is_that_of_its_least_certain_fix() {
        let of = |x, y, heading| {
            let certainty = Certainty { x, y, heading };
            let robot = Sighting::usual(RobotId(1), Pose::default());
            (Instant::default(), Sighting { certainty, ..robot })
        };
        let (first, second) = (of(5, 30, 7), of(9, 4, 8));
        assert_eq!(least_certain(&[first, second]), Certainty { x: 9, y: 30, heading: 8 });
        assert_eq!(least_certain(&[first]), first.1.certainty);
    }
}
