//! A frontier that a robot goes to look at, and one that it looked at in vain.

use ubimap_protocol::time::{Duration, Instant};

use super::ground::{Disc, Point};

/// A frontier that a robot goes to look at.
#[derive(Clone, Copy, Debug)]
pub(super) struct Target {
    /// Where the frontier was.
    pub(super) frontier: Point,
    /// Where to look at it from.
    pub(super) view: Point,
    /// When the robot arrived there.
    pub(super) reached: Option<Instant>,
    /// When it reported that it had looked around.
    pub(super) looked: Option<Instant>,
}

impl Target {
    /// A frontier to be looked at from a place.
    pub(super) fn new(frontier: Point, view: Point) -> Self {
        Self { frontier, view, reached: None, looked: None }
    }

    /// Whether the robot has looked at it, and what it saw has had this long to arrive.
    pub(super) fn is_heard_of(&self, arrives: Duration, now: Instant) -> bool {
        self.looked.is_some_and(|looked| now.since(looked) >= arrives)
    }
}

/// A frontier that was looked at in vain, or that could not be reached.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tried {
    frontier: Point,
    view: Point,
    /// When it may be tried again.
    pub(super) until: Instant,
}

impl Tried {
    pub(super) fn new(target: &Target, until: Instant) -> Self {
        Self { frontier: target.frontier, view: target.view, until }
    }

    /// Whether it is the frontier at this place, within a radius in metres.
    pub(super) fn is_of(&self, frontier: Point, radius_m: f64) -> bool {
        (self.frontier - frontier).norm() <= radius_m
    }

    /// The places that count as the one it was looked at from, within a radius in metres.
    pub(super) fn views(&self, radius_m: f64) -> Disc {
        Disc { centre: self.view, radius: radius_m }
    }
}
