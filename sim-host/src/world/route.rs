//! Routes from stop to stop, and who must wait for whom.

use parry2d_f64::glamx::DVec2;

/// Minimum distance between two bodies in metres.
const APART: f64 = 0.02;

/// A person or robot as an obstacle to others: an upright cylinder.
#[derive(Clone, Copy, Debug)]
pub(super) struct Body {
    pub(super) centre: DVec2,
    pub(super) radius: f64,
    pub(super) height: f64,
}

impl Body {
    /// Whether `other` is in the way, within `gap` ahead of this body.
    pub(super) fn is_blocked(&self, heading: DVec2, other: &Body, gap: f64) -> bool {
        let offset = other.centre - self.centre;
        let reach = self.radius + other.radius;
        let ahead = offset.dot(heading);
        let aside = heading.perp_dot(offset).abs();
        ahead > 0.0 && ahead < reach + gap && aside < reach + 2.0 * APART
    }

    /// Whether moving to `centre` would bring this body into contact with `other`.
    pub(super) fn meets(&self, centre: DVec2, other: &Body) -> bool {
        let distance = centre.distance(other.centre);
        distance < self.radius + other.radius && distance < self.centre.distance(other.centre)
    }

    /// Whether moving to `centre` would bring this body too close to `other`.
    pub(super) fn would_touch(&self, centre: DVec2, other: &Body) -> bool {
        let distance = centre.distance(other.centre);
        distance < self.radius + other.radius + APART
            && distance < self.centre.distance(other.centre)
    }
}

/// Stops that are visited in a cycle.
#[derive(Clone, Debug)]
pub(super) struct Route {
    stops: Vec<DVec2>,
    /// Index of the next stop.
    next: usize,
    backward: bool,
}

impl Route {
    /// A route that starts at its first stop; there is at least one.
    pub(super) fn new(first: DVec2, others: impl IntoIterator<Item = DVec2>) -> Self {
        let mut stops = vec![first];
        stops.extend(others);
        // Ignore a stop at the same place as the previous one.
        stops.dedup_by(|stop, before| stop.distance(*before) < 1e-6);
        let next = usize::from(stops.len() > 1);
        Self { stops, next, backward: false }
    }

    /// The next stop; `None` if there is only one.
    pub(super) fn target(&self) -> Option<DVec2> {
        (self.stops.len() > 1).then(|| self.stops[self.next])
    }

    /// Continues to the next stop.
    pub(super) fn arrive(&mut self) {
        let count = self.stops.len();
        let step = if self.backward { count - 1 } else { 1 };
        self.next = (self.next + step) % count;
    }

    /// Turns back to the previous stop and continues in reverse order.
    pub(super) fn turn_round(&mut self) {
        self.backward = !self.backward;
        self.arrive();
    }
}
