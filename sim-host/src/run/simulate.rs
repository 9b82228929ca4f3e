//! `ubimap simulate`: robots in a simulated room.

use super::{Outcome, RunError, options::SimulateOptions};

/// Runs a scenario.
pub fn run(_options: &SimulateOptions) -> Result<Outcome, RunError> {
    Err(RunError::NotBuilt("simulate"))
}
