//! The fixes of one robot on their way to it.

use ubimap_protocol::{
    message::{Certainty, FixSource, MAX_EARLIER_FIXES, PoseFix, ToRobot, Writer},
    time::{Duration, Instant},
};

use crate::camera::Sighting;

/// The shortest time from one message with fixes to the next, however many cameras see the robot:
/// each message carries the fixes before it as well.
const INTERVAL: Duration = Duration::from_millis(60);

/// What cameras saw of a robot, and where a match with the map found it.
#[derive(Debug, Default)]
pub(super) struct Fixes {
    newest_first: Vec<(Instant, Sighting)>,
    /// Whether the newest has not been sent.
    is_due: bool,
    next: Instant,
    /// A fix from a match with the map.
    matched: Option<PoseFix>,
}

impl Fixes {
    /// Takes what a camera saw. A fix that is not newer than all before it is left out.
    pub(super) fn add(&mut self, moment: Instant, sighting: Sighting) {
        if self.newest_first.first().is_some_and(|&(newest, _)| newest >= moment) {
            return;
        }
        self.newest_first.insert(0, (moment, sighting));
        self.newest_first.truncate(1 + MAX_EARLIER_FIXES);
        self.is_due = true;
    }

    /// Takes a fix from a match with the map.
    pub(super) fn add_matched(&mut self, fix: PoseFix) {
        self.matched = Some(fix);
    }

    /// Whether there is one to be sent now.
    pub(super) fn is_ready(&self, now: Instant) -> bool {
        self.is_camera_fix_ready(now) || self.matched.is_some()
    }

    fn is_camera_fix_ready(&self, now: Instant) -> bool {
        self.is_due && self.next <= now
    }

    /// Adds what is ready to a frame.
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

    /// When there is one to be sent.
    pub(super) fn poll_timeout(&self, now: Instant) -> Option<Instant> {
        if self.matched.is_some() { Some(now) } else { self.is_due.then_some(self.next) }
    }

    /// Messages that wait to be sent.
    pub(super) fn waiting(&self) -> usize {
        usize::from(self.is_due) + usize::from(self.matched.is_some())
    }
}

/// A certainty that holds for each of some fixes.
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
    fn what_is_said_of_several_fixes_holds_for_the_least_certain() {
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
