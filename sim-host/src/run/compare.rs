//! `ubimap compare`: one ROS map against another.

use super::{RunError, options::CompareOptions};
use crate::grid::{self, Scores};

/// Reads both maps and scores the one against the other.
pub fn run(options: &CompareOptions) -> Result<Scores, RunError> {
    let map = grid::read_map(&options.map)?;
    let reference = grid::read_map(&options.reference)?;
    Ok(grid::compare(&map, &reference, options.tolerance))
}

/// The scores as lines for people.
pub fn describe(scores: &Scores) -> String {
    format!(
        "occupied cells within {:.3} m: precision {:.4}, recall {:.4}, F1 {:.4} ({} against {})\n\
         cells known in both: {:.4} of {} agree\n",
        scores.tolerance_m,
        scores.precision,
        scores.recall,
        scores.f1,
        scores.occupied,
        scores.occupied_reference,
        scores.agreement_known,
        scores.known_in_both,
    )
}
