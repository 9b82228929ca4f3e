//! What is known of one robot, and what it is to do.

use ubimap_protocol::{
    time::{Duration, Instant},
    units::RobotId,
};

use super::{ground::Point, settings::Following, situation::Whereabouts, target::Target};

/// One robot.
#[derive(Clone, Debug)]
pub(super) struct Member {
    pub(super) id: RobotId,
    /// Of a disc that holds it however it turns, in metres.
    pub(super) radius_m: f64,
    /// Since when it has no session.
    pub(super) lost: Option<Instant>,
    /// Whether it goes where nobody has been when it has no goal.
    pub(super) explores: bool,
    /// What a user wants; it goes before any frontier.
    pub(super) goal: Option<Point>,
    pub(super) target: Option<Target>,
    /// Since when it was told to stand, to be given another route from where it comes to stand.
    pub(super) halted: Option<Instant>,
    /// Since when somebody who is no robot stands before it.
    pub(super) held_up: Option<Instant>,
    /// Since when it waits for a route, and when one is looked for again.
    pub(super) waits_since: Option<Instant>,
    pub(super) retry: Instant,
    /// Whether it was said that there is no way to where it is to go.
    pub(super) is_told: bool,
    /// When it was sent something last.
    pub(super) sent: Instant,
    /// Where it looks, in radians in `map`.
    pub(super) heading: f64,
    still_at: Point,
    still_since: Instant,
    seen: Instant,
}

impl Member {
    pub(super) fn new(robot: &Whereabouts) -> Self {
        Self {
            id: robot.robot,
            radius_m: robot.radius_m(),
            lost: None,
            explores: false,
            goal: None,
            target: None,
            halted: None,
            held_up: None,
            waits_since: None,
            retry: Instant(0),
            is_told: false,
            sent: Instant(0),
            heading: robot.pose.heading.radians(),
            still_at: robot.place(),
            still_since: robot.moment,
            seen: robot.moment,
        }
    }

    /// It was seen. Returns whether it has come back after it was lost.
    pub(super) fn see(&mut self, robot: &Whereabouts, rules: &Following, now: Instant) -> bool {
        self.radius_m = robot.radius_m();
        self.heading = robot.pose.heading.radians();
        self.seen = self.seen.max(robot.moment);
        if (robot.place() - self.still_at).norm() > rules.still_m {
            (self.still_at, self.still_since) = (robot.place(), robot.moment);
        }
        let was_lost = self.lost.is_some();
        self.lost = (!robot.has_session).then(|| self.lost.unwrap_or(now));
        was_lost && robot.has_session
    }

    /// For how long it was seen to stand.
    pub(super) fn still_for(&self) -> Duration {
        self.seen.since(self.still_since)
    }

    /// For how long nobody has seen it move. Where no camera sees it a robot that stands does not
    /// say so anew, and one that drives says where it is now and then.
    pub(super) fn unmoved_for(&self, now: Instant) -> Duration {
        now.since(self.still_since)
    }

    /// Where it is to go.
    pub(super) fn destination(&self) -> Option<Point> {
        self.goal.or(self.target.map(|target| target.view))
    }

    /// Whether a place is where it is to go.
    pub(super) fn is_there(&self, place: Point, rules: &Following) -> bool {
        self.destination().is_some_and(|it| (it - place).norm() <= rules.arrived_m)
    }

    /// Whether it can be told to drive.
    pub(super) fn can_drive(&self) -> bool {
        self.lost.is_none() && self.halted.is_none()
    }

    /// It is to go somewhere else.
    pub(super) fn set_out(&mut self, now: Instant) {
        self.is_told = false;
        self.retry = now;
        self.waits_since = None;
    }
}
