//! The points of a path, joined by straight lines.

use heapless::Vec;

use super::plane::Place;

/// Maximum number of points of a path; longer paths are cut off.
pub(super) const MAX_POINTS: usize = 32;

/// Cells of a window in driving order, including the start. Each
/// [sees](super::PlanningWindow::sees) the next.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Path {
    /// The points.
    pub places: Vec<Place, MAX_POINTS>,
    /// Whether the path is complete: the last point is the goal.
    pub is_whole: bool,
}
