//! The few points between which the robot drives straight.

use heapless::Vec;

use super::plane::Place;

/// The most points of a path. Of a longer one the first are kept.
pub(super) const MAX_POINTS: usize = 32;

/// Cells of a window in the order in which they are driven through, the start among them. Each
/// [sees](super::PlanningWindow::sees) the next.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Path {
    /// The points.
    pub places: Vec<Place, MAX_POINTS>,
    /// Whether the last one is the end of the way.
    pub is_whole: bool,
}
