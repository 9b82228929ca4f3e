//! `ubimap backup`: a copy of a store.

use super::{RunError, options::BackupOptions};
use crate::store;

/// Copies the store. Returns the number of robots' tiles in the copy, counted by epoch.
pub fn run(options: &BackupOptions) -> Result<u32, RunError> {
    Ok(store::backup(&options.store, &options.to)?)
}
