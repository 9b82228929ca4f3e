//! The labels of an option.

use std::path::Path;

use super::RunError;
use crate::grid::{Label, read_labels};

/// The labels of a file, if one is given.
///
/// # Errors
/// [`RunError::Labels`].
pub(super) fn read(path: Option<&Path>) -> Result<Vec<Label>, RunError> {
    let Some(path) = path else { return Ok(Vec::new()) };
    read_labels(path).map_err(|reason| RunError::Labels { path: path.to_owned(), reason })
}
