//! Ways from stop to stop, and who has to wait for whom.

use parry2d_f64::glamx::DVec2;

/// Two bodies never come nearer than this, in metres.
const APART: f64 = 0.02;

/// What everybody else is to somebody who moves: an upright cylinder.
#[derive(Clone, Copy, Debug)]
pub(super) struct Body {
    pub(super) centre: DVec2,
    pub(super) radius: f64,
    pub(super) height: f64,
}

impl Body {
    /// Whether `other` stands in the way within `gap` ahead of this body.
    pub(super) fn is_blocked(&self, heading: DVec2, other: &Body, gap: f64) -> bool {
        let offset = other.centre - self.centre;
        let reach = self.radius + other.radius;
        let ahead = offset.dot(heading);
        let aside = heading.perp_dot(offset).abs();
        ahead > 0.0 && ahead < reach + gap && aside < reach + 2.0 * APART
    }

    /// Whether this body would touch `other` at `centre`, and come nearer.
    pub(super) fn meets(&self, centre: DVec2, other: &Body) -> bool {
        let distance = centre.distance(other.centre);
        distance < self.radius + other.radius && distance < self.centre.distance(other.centre)
    }

    /// Whether moving to `centre` would bring this body nearly into touch with `other`.
    pub(super) fn would_touch(&self, centre: DVec2, other: &Body) -> bool {
        let distance = centre.distance(other.centre);
        distance < self.radius + other.radius + APART
            && distance < self.centre.distance(other.centre)
    }
}

/// Stops that are visited in turn, the first again after the last.
#[derive(Clone, Debug)]
pub(super) struct Route {
    stops: Vec<DVec2>,
    /// The stop that is headed for.
    next: usize,
    backward: bool,
}

impl Route {
    /// A route of somebody who is at the first stop now; there is at least one.
    pub(super) fn new(first: DVec2, others: impl IntoIterator<Item = DVec2>) -> Self {
        let mut stops = vec![first];
        stops.extend(others);
        // A stop at the same place as the one before is no way.
        stops.dedup_by(|stop, before| stop.distance(*before) < 1e-6);
        let next = usize::from(stops.len() > 1);
        Self { stops, next, backward: false }
    }

    /// Where to go, or `None` for somebody who stays.
    pub(super) fn target(&self) -> Option<DVec2> {
        (self.stops.len() > 1).then(|| self.stops[self.next])
    }

    /// The stop is reached: on to the next.
    pub(super) fn arrive(&mut self) {
        let count = self.stops.len();
        let step = if self.backward { count - 1 } else { 1 };
        self.next = (self.next + step) % count;
    }

    /// Back to the stop before, and on from there in the other sense.
    pub(super) fn turn_round(&mut self) {
        self.backward = !self.backward;
        self.arrive();
    }
}
