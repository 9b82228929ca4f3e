//! `ubimap replay`: robots on the scans of a recorded log.

use super::{Outcome, RunError, options::ReplayOptions};

/// Runs the logs through robots, channels and the server.
pub fn run(_options: &ReplayOptions) -> Result<Outcome, RunError> {
    Err(RunError::NotBuilt("replay"))
}
