//! Why cameras can't be placed.

use std::{fmt, path::Path};

/// Why cameras can't be placed: one line that names the file or the room.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{what}: {reason}")]
pub struct PlaceFault {
    what: String,
    reason: String,
    is_unanswered: bool,
}

impl PlaceFault {
    /// A fault of a file, or of what was asked of the room in it.
    pub(super) fn in_file(path: &Path, reason: &dyn fmt::Display) -> Self {
        Self { what: path.display().to_string(), reason: reason.to_string(), is_unanswered: false }
    }

    /// The time limit passed without an answer, or a solver failed; there may be an answer.
    pub(super) fn unanswered(room: &Path, reason: &dyn fmt::Display) -> Self {
        Self { is_unanswered: true, ..Self::in_file(room, reason) }
    }

    /// Whether the input or the request is at fault, and not the run.
    pub fn is_bad_input(&self) -> bool {
        !self.is_unanswered
    }
}
