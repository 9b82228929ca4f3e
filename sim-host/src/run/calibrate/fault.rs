//! Why cameras can't be calibrated.

use std::{fmt, path::Path};

/// Why cameras can't be calibrated, as one line that names the file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{path}: {reason}")]
pub struct CalibrateFault {
    path: String,
    reason: String,
}

impl CalibrateFault {
    pub(super) fn in_file(path: &Path, reason: &dyn fmt::Display) -> Self {
        Self { path: path.display().to_string(), reason: reason.to_string() }
    }
}
