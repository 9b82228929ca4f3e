//! The state and the task of one robot.

use ubimap_protocol::{
    time::{Duration, Instant},
    units::RobotId,
};

use super::{
    ground::Point,
    odometry_calibration::OdometryCalibration,
    settings::{EscalationRules, FollowingRules, Settings},
    situation::Whereabouts,
    target::{Target, Tried},
};

/// One robot.
#[derive(Clone, Debug)]
pub(super) struct Member {
    pub(super) id: RobotId,
    /// Circumscribed radius in metres.
    pub(super) radius_m: f64,
    /// When the robot became unreachable; `None` if it is reachable.
    pub(super) lost: Option<Instant>,
    /// Whether the robot explores while it has no goal.
    pub(super) explores: bool,
    /// The goal given by a user; it takes precedence over frontiers.
    pub(super) goal: Option<Point>,
    pub(super) target: Option<Target>,
    /// Where the robot drives to in the cameras' view, while it has neither goal nor target.
    pub(super) refuge: Option<Point>,
    /// Distance that the robot has driven in the cameras' view, in metres. Includes short moves, from which robots learn
    /// little.
    pub(super) seen_m: f64,
    pub(super) calibration: OdometryCalibration,
    /// How often in a row it could not be calibrated.
    uncalibrated: u32,
    /// Distance that the robot has driven since cameras last saw it, in metres.
    driven_m: f64,
    /// When it may next be called back into view for that; `None` while it is called back.
    pub(super) recall: Option<Instant>,
    /// Since when it has had nothing to do.
    pub(super) idle_since: Option<Instant>,
    /// Since when it has been idle, and could reach no viewpoint of a frontier that is left.
    pub(super) shut_in_since: Option<Instant>,
    /// Whether [`Notice::ShutIn`](super::situation::Notice::ShutIn) was issued since it was last out.
    pub(super) is_given_up: bool,
    /// Where it looked in vain for a way out of the place where it is.
    pub(super) no_way_out: Vec<Tried>,
    /// When the robot was told to stop in order to get another route; `None` if it was not.
    pub(super) halted: Option<Instant>,
    /// Where the robot was last blocked.
    pub(super) trouble: Option<Trouble>,
    /// When a person began to block the robot's way.
    pub(super) held_up: Option<Instant>,
    /// When the robot last reported that it stood for a person.
    pub(super) stood_for_person: Option<Instant>,
    /// When the robot began to wait for a route, and when the search is repeated.
    pub(super) waits_since: Option<Instant>,
    pub(super) retry: Instant,
    /// Whether [`Notice::NoWay`](super::situation::Notice::NoWay) was issued for the current goal.
    pub(super) is_told: bool,
    /// When the robot was last sent a path.
    pub(super) sent: Instant,
    /// Heading in radians in `map`.
    pub(super) heading: f64,
    place: Point,
    still_at: Point,
    still_since: Instant,
    seen: Instant,
}

/// A place where a robot was blocked.
#[derive(Clone, Copy, Debug)]
pub(super) struct Trouble {
    at: Point,
    /// How often in a row.
    pub(super) times: u32,
    /// Until when the robot pauses there.
    pub(super) until: Instant,
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
            refuge: None,
            seen_m: 0.0,
            calibration: OdometryCalibration::Missing(Instant(0)),
            uncalibrated: 0,
            driven_m: 0.0,
            recall: Some(Instant(0)),
            idle_since: None,
            shut_in_since: None,
            is_given_up: false,
            no_way_out: Vec::new(),
            halted: None,
            trouble: None,
            held_up: None,
            stood_for_person: None,
            waits_since: None,
            retry: Instant(0),
            is_told: false,
            sent: Instant(0),
            heading: robot.pose.heading.radians(),
            place: robot.place(),
            still_at: robot.place(),
            still_since: robot.moment,
            seen: robot.moment,
        }
    }

    /// Updates the state from a sighting or a report. Returns whether the robot has become
    /// reachable again.
    pub(super) fn see(
        &mut self,
        robot: &Whereabouts,
        rules: &FollowingRules,
        now: Instant,
    ) -> bool {
        self.radius_m = robot.radius_m();
        self.heading = robot.pose.heading.radians();
        self.seen = self.seen.max(robot.moment);
        let step_m = (robot.place() - core::mem::replace(&mut self.place, robot.place())).norm();
        let is_seen = robot.is_in_view && self.driven_m == 0.0;
        self.driven_m = if robot.is_in_view { 0.0 } else { self.driven_m + step_m };
        let moved_m = (robot.place() - self.still_at).norm();
        if moved_m > rules.still_m {
            self.seen_m += if is_seen && moved_m < rules.jump_m { moved_m } else { 0.0 };
            (self.still_at, self.still_since) = (robot.place(), robot.moment);
        }
        let was_lost = self.lost.is_some();
        self.lost = (!robot.obeys).then(|| self.lost.unwrap_or(now));
        was_lost && robot.obeys
    }

    /// Time for which the robot has been seen standing still.
    pub(super) fn still_for(&self) -> Duration {
        self.seen.since(self.still_since)
    }

    /// Time since the robot was last known to move. A robot may know its pose no longer, and repeat none;
    /// one that drives out of view reports it every 2 s.
    pub(super) fn unmoved_for(&self, now: Instant) -> Duration {
        now.since(self.still_since)
    }

    /// The robot's goal, or the viewpoint of its target, or its refuge.
    pub(super) fn destination(&self) -> Option<Point> {
        self.goal.or(self.target.map(|target| target.view)).or(self.refuge)
    }

    /// The target, unless the robot is shut in, and leaves the frontier to others.
    pub(super) fn frontier_target(&self) -> Option<Target> {
        self.target.filter(|target| !target.is_shut_in)
    }

    /// Whether the robot may be given something to look at.
    pub(super) fn is_idle(&self) -> bool {
        let is_free = self.recall.is_some() && !self.calibration.is_due();
        self.is_exploring() && self.target.is_none() && is_free
    }

    /// Whether the robot is to drive to and fro in view now.
    pub(super) fn calibrates(&self) -> bool {
        let is_free = self.target.is_none() && self.recall.is_some();
        self.is_exploring() && self.calibration.is_due() && is_free
    }

    /// Whether the robot explores now.
    pub(super) fn is_exploring(&self) -> bool {
        self.explores && self.goal.is_none() && self.can_drive()
    }

    /// Whether the robot should come into view, since its pose may have drifted: after the look that it is on its
    /// way to.
    pub(super) fn is_adrift(&self, blind_m: f64) -> bool {
        self.driven_m > blind_m && (self.target.is_none() || self.recall.is_none())
    }

    /// Whether a place is close enough to the robot's destination.
    pub(super) fn is_there(&self, place: Point, rules: &FollowingRules) -> bool {
        self.destination().is_some_and(|it| (it - place).norm() <= rules.arrived_m)
    }

    /// Notes that the robot was blocked at `at`, and lets it pause. Returns how often in a row it was blocked
    /// there.
    pub(super) fn block(&mut self, at: Point, rules: &EscalationRules, now: Instant) -> u32 {
        let before = self.trouble.filter(|it| (it.at - at).norm() <= rules.same_m);
        let times = before.map_or(1, |it| it.times.saturating_add(1));
        let pause = if times > 1 { rules.longer(rules.pause, times) } else { Duration(0) };
        self.trouble = Some(Trouble { at, times, until: now + pause });
        times
    }

    /// Whether the robot pauses where it was blocked.
    pub(super) fn pauses(&self, now: Instant) -> bool {
        self.trouble.is_some_and(|it| now < it.until)
    }

    /// Whether the robot can be commanded to drive.
    pub(super) fn can_drive(&self) -> bool {
        self.lost.is_none() && self.halted.is_none()
    }

    /// Whether the robot stands, or stood until a moment ago, because a person was in its way.
    pub(super) fn is_behind_person(&self, rules: &FollowingRules, now: Instant) -> bool {
        self.stood_for_person.is_some_and(|then| now.since(then) <= rules.behind_person)
    }

    /// Clears the robot's goal, target, refuge and recall, and its memory of where it was blocked.
    pub(super) fn end_errand(&mut self) {
        (self.goal, self.target, self.refuge) = (None, None, None);
        self.trouble = None;
        self.cancel_recall();
    }

    /// Cancels a recall into view, and a calibration that is due.
    pub(super) fn cancel_recall(&mut self) {
        self.recall = Some(Instant(0));
        self.calibration.put_off(Instant(0));
    }

    /// Cancels a calibration that is due and can't be done now. The next attempt comes later each time.
    pub(super) fn fail_calibration(&mut self, settings: &Settings, now: Instant) {
        self.uncalibrated = self.uncalibrated.saturating_add(1);
        let put_off = settings.escalation.longer(settings.calibration.put_off, self.uncalibrated);
        self.calibration.put_off(now + put_off);
    }

    /// Notes that the odometry is no longer calibrated.
    pub(super) fn lose_calibration(&mut self) {
        (self.seen_m, self.uncalibrated) = (0.0, 0);
        if !self.calibration.is_due() {
            self.calibration = OdometryCalibration::Missing(Instant(0));
        }
    }

    /// Prepares for a new destination.
    pub(super) fn set_out(&mut self, now: Instant) {
        self.is_told = false;
        self.retry = now;
        self.waits_since = None;
    }
}
