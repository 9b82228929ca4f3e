//! Why cameras can't be calibrated.

use std::{fmt, path::Path};

/// Why cameras can't be calibrated, as one line that names the file or the option.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{what}: {reason}")]
pub struct CalibrateFault {
    what: String,
    reason: String,
}

impl CalibrateFault {
    pub(super) fn in_file(path: &Path, reason: &dyn fmt::Display) -> Self {
        Self::of(&path.display().to_string(), reason)
    }

    /// A fault of a file or an option.
    pub(in super::super) fn of(what: &str, reason: &dyn fmt::Display) -> Self {
        Self { what: what.to_owned(), reason: reason.to_string() }
    }
}
