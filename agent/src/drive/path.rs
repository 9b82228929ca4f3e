//! A way with its corners cut: the few points between which the robot drives straight.

use heapless::Vec;

use super::{plane::Place, window::Window};

/// The most points of a path. Of a longer one the first are kept.
pub(super) const MAX_POINTS: usize = 32;

/// Cells of a window in the order in which they are driven through, the start among them. Each
/// [sees](Window::sees) the next.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Path {
    /// The points.
    pub places: Vec<Place, MAX_POINTS>,
    /// Whether the last one is the end of the way.
    pub is_whole: bool,
}

/// A way that is walked from its end to its start.
#[derive(Debug)]
pub(super) struct WayBack {
    /// Filled from the back, in the order in which they are driven through.
    places: [Place; MAX_POINTS],
    /// The first of them.
    first: usize,
    /// Whether the end had to be dropped.
    is_cut: bool,
    /// The newest cell, which sees the first point.
    seen: Place,
}

impl WayBack {
    pub(super) fn from(end: Place) -> Self {
        Self { places: [end; MAX_POINTS], first: MAX_POINTS - 1, is_cut: false, seen: end }
    }

    /// The next cell. A point is set where the last one does not see further.
    pub(super) fn lead(&mut self, place: Place, window: &Window) {
        let last = self.places[self.first % MAX_POINTS];
        if !sees(window, place, last) {
            self.set(self.seen);
        }
        self.seen = place;
    }

    fn set(&mut self, place: Place) {
        match self.first.checked_sub(1) {
            Some(first) => self.first = first,
            None => {
                for index in (1..MAX_POINTS).rev() {
                    self.places[index] = self.places[index - 1];
                }
                self.is_cut = true;
            }
        }
        self.places[self.first % MAX_POINTS] = place;
    }

    /// The newest cell is the start. Points that can be left out are left out.
    pub(super) fn finish(mut self, window: &Window) -> Path {
        self.set(self.seen);
        let mut places = Vec::new();
        let mut rest = self.places.get(self.first..).unwrap_or_default();
        while let Some((&place, after)) = rest.split_first() {
            // As many points as there were at the most.
            let _ = places.push(place);
            let next = after.iter().rposition(|&further| sees(window, place, further));
            rest = after.get(next.unwrap_or(0)..).unwrap_or_default();
        }
        Path { places, is_whole: !self.is_cut }
    }
}

/// Sees it, and crosses nothing dear on the way unless both ends are: there the way is the
/// planner's.
fn sees(window: &Window, from: Place, to: Place) -> bool {
    if window.dear.has(from) && window.dear.has(to) {
        return window.sees(from, to);
    }
    window.sees_cheaply(from, to)
}
