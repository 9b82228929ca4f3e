//! Ground that robots have driven over.

use std::collections::BTreeSet;

use super::ground::Point;

/// Maximum way between two places of a robot, in metres, to have been driven: beyond it, its pose was corrected.
const STEP_M: f64 = 0.3;

/// The cells on which the centres of robots have been, and those beside. Where a robot has passed, there is room for it, even
/// if the walls of a door are drawn thicker than they are.
#[derive(Clone, Debug, Default)]
pub(super) struct Walked {
    cells: BTreeSet<(i32, i32)>,
}

impl Walked {
    /// A robot has driven from one place to another; cells have a side of `side_m`.
    pub(super) fn pass(&mut self, from: Point, to: Point, side_m: f64) {
        let way = to - from;
        let from = if way.norm() > STEP_M { to } else { from };
        let steps = (2.0 * (to - from).norm() / side_m).ceil();
        for step in 0..=steps as usize {
            let at = from + (to - from) * (step as f64 / steps.max(1.0));
            // The casts saturate.
            let [x, y] = [at.x, at.y].map(|metres| (metres / side_m).floor() as i32);
            let beside = |cell: i32| cell.saturating_sub(1)..=cell.saturating_add(1);
            self.cells.extend(beside(x).flat_map(|x| beside(y).map(move |y| (x, y))));
        }
    }

    /// The centres of the cells.
    pub(super) fn places(&self, side_m: f64) -> impl Iterator<Item = Point> {
        let centre = move |cell: i32| (f64::from(cell) + 0.5) * side_m;
        self.cells.iter().map(move |&(x, y)| Point::new(centre(x), centre(y)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_walked_without_gaps_but_not_by_corrections() {
        let mut walked = Walked::default();
        walked.pass(Point::new(0.0, 0.0), Point::new(0.2, 0.1), 0.05);
        for (x, y) in [(0, 0), (1, 0), (2, 1), (3, 1), (4, 2), (5, 3), (-1, -1)] {
            assert!(walked.cells.contains(&(x, y)), "{x} {y}");
        }
        assert!(!walked.cells.contains(&(0, 3)) && !walked.cells.contains(&(6, 2)));
        walked.pass(Point::new(1.0, 1.0), Point::new(3.0, 1.0), 0.05);
        assert!(walked.cells.contains(&(60, 20)) && !walked.cells.contains(&(40, 20)));
    }
}
