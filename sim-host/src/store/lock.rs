//! Exclusive use of a store by one process.
//!
//! SQLite's own exclusive mode would also exclude `ubimap backup`, which only reads.

use std::{
    ffi::OsString,
    fs::{self, File, OpenOptions, TryLockError},
    path::Path,
};

use super::Trouble;

/// Locks a store until the returned file is dropped, or the process ends in any way. The lock is on
/// a separate file beside the store, `NAME-lock`, which is never deleted. The store's own file
/// can't be used: closing a second handle of it would release SQLite's locks.
pub(super) fn lock(store: &Path) -> Result<File, Trouble> {
    // Different paths of the same file must share the lock.
    let real = fs::canonicalize(store).map_err(|_| Trouble::CannotOpen)?;
    let mut name = OsString::from(real);
    name.push("-lock");
    let file = OpenOptions::new().create(true).truncate(false).write(true).open(name);
    let file = file.map_err(|_| Trouble::CannotOpen)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(Trouble::InUse),
        Err(TryLockError::Error(_)) => Err(Trouble::CannotOpen),
    }
}
