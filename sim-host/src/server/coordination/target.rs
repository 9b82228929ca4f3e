//! Targets: places that robots are sent to look at, and those where they saw nothing.

use ubimap_protocol::time::{Duration, Instant};

use super::ground::{Disc, Point};

/// A frontier that a robot is sent to look at, or, if it is shut in, what blocks its way to one.
#[derive(Clone, Copy, Debug)]
pub(super) struct Target {
    /// Position of the frontier.
    pub(super) frontier: Point,
    /// Whether the robot is shut in, and looks for a way out. The frontier is then left to the other robots.
    pub(super) is_shut_in: bool,
    /// The viewpoint.
    pub(super) view: Point,
    /// When the robot arrived there.
    pub(super) reached: Option<Instant>,
    /// When the robot reported that it had looked around.
    pub(super) looked: Option<Instant>,
}

impl Target {
    /// A frontier with its viewpoint.
    pub(super) fn new(frontier: Point, view: Point) -> Self {
        Self { frontier, is_shut_in: false, view, reached: None, looked: None }
    }

    /// The same for a robot that is shut in.
    pub(super) fn shut_in(self) -> Self {
        Self { is_shut_in: true, ..self }
    }

    /// Whether the robot looked at the frontier at least `arrives` ago, so that its tiles have
    /// arrived.
    pub(super) fn is_heard_of(&self, arrives: Duration, now: Instant) -> bool {
        self.looked.is_some_and(|looked| now.since(looked) >= arrives)
    }
}

/// A frontier that could not be reached, or not be seen from a viewpoint.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tried {
    frontier: Point,
    view: Point,
    /// When the frontier may be tried again from this viewpoint.
    pub(super) until: Instant,
}

impl Tried {
    pub(super) fn new(target: &Target, until: Instant) -> Self {
        Self { frontier: target.frontier, view: target.view, until }
    }

    /// Whether the frontier is within `radius_m` metres of the position `frontier`.
    pub(super) fn is_of(&self, frontier: Point, radius_m: f64) -> bool {
        (self.frontier - frontier).norm() <= radius_m
    }

    /// The disc, of `radius_m` metres, in which viewpoints count as equal to the failed one.
    pub(super) fn views(&self, radius_m: f64) -> Disc {
        Disc { centre: self.view, radius: radius_m }
    }
}
