//! Why cameras can't be placed.

use std::{fmt, path::Path};

/// Why cameras can't be placed, as one line that names the file or the room.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{what}: {reason}")]
pub struct PlaceFault {
    what: String,
    reason: String,
    is_unanswered: bool,
}

impl PlaceFault {
    /// An invalid file, or a request that its room can't meet.
    pub(super) fn in_file(path: &Path, reason: &dyn fmt::Display) -> Self {
        Self { what: path.display().to_string(), reason: reason.to_string(), is_unanswered: false }
    }

    /// No placement found within the time limit, or a solver failed; a placement may still exist.
    pub(super) fn unanswered(room: &Path, reason: &dyn fmt::Display) -> Self {
        Self { is_unanswered: true, ..Self::in_file(room, reason) }
    }

    /// Whether the input or the request is at fault, rather than the run.
    pub fn is_bad_input(&self) -> bool {
        !self.is_unanswered
    }
}
