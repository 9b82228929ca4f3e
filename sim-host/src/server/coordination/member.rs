//! What is known of one robot, and what it is to do.

use ubimap_protocol::{
    time::{Duration, Instant},
    units::RobotId,
};

use super::{ground::Point, situation::Whereabouts};

/// Whoever has moved less stands, in metres.
const STILL_M: f64 = 0.03;

/// The end of a path is reached if a robot stops so near to it, in metres.
pub(super) const ARRIVED_M: f64 = 0.25;

/// Until the server has heard what a robot saw.
const HEARD: Duration = Duration::from_millis(500);

/// A frontier that a robot goes to look at.
#[derive(Clone, Copy, Debug)]
pub(super) struct Target {
    /// Where the frontier was.
    pub(super) frontier: Point,
    /// Where to look at it from.
    pub(super) view: Point,
    /// Since when the robot stands there, and when it said that it had looked around.
    pub(super) reached: Option<Instant>,
    pub(super) looked: Option<Instant>,
}

impl Target {
    /// A frontier to be looked at from a place.
    pub(super) fn new(frontier: Point, view: Point) -> Self {
        Self { frontier, view, reached: None, looked: None }
    }

    /// Whether the robot has looked at it, and the server has heard what it saw.
    pub(super) fn is_heard_of(&self, now: Instant) -> bool {
        self.looked.is_some_and(|looked| now.since(looked) >= HEARD)
    }
}

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

    /// It was seen. Whether it has come back after it was lost.
    pub(super) fn see(&mut self, robot: &Whereabouts, now: Instant) -> bool {
        self.radius_m = robot.radius_m();
        self.heading = robot.pose.heading.radians();
        self.seen = self.seen.max(robot.moment);
        if (robot.place() - self.still_at).norm() > STILL_M {
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
    pub(super) fn is_there(&self, place: Point) -> bool {
        self.destination().is_some_and(|it| (it - place).norm() <= ARRIVED_M)
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
