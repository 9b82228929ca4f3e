//! Checks that the files of an open store are still on disk. SQLite continues to write to a file
//! that was deleted or replaced, and those writes are lost when the process ends.

use std::{
    ffi::OsString,
    fs::{self, Metadata},
    path::{Path, PathBuf},
};

use super::Trouble;

/// The files of an open store, as last seen on disk. Neither of them shrinks while the store is
/// open: the database is never vacuumed, and a checkpoint does not change the length of the log.
#[derive(Debug)]
pub(super) struct Presence {
    database: Watched,
    log: Watched,
}

#[derive(Debug)]
struct Watched {
    path: PathBuf,
    /// `None` until the file was first seen.
    last: Option<FileState>,
}

#[derive(Clone, Copy, Debug)]
struct FileState {
    /// Device and inode.
    #[cfg(unix)]
    identity: (u64, u64),
    len: u64,
}

impl Presence {
    /// Starts to watch the files of an open database.
    pub(super) fn new(path: &Path) -> Result<Self, Trouble> {
        // If the path is a symbolic link, the log is beside the file to which it points.
        let real = fs::canonicalize(path).map_err(|_| Trouble::Gone)?;
        let mut log = OsString::from(real);
        log.push("-wal");
        let database = Watched { path: path.to_owned(), last: None };
        let mut presence = Self { database, log: Watched { path: log.into(), last: None } };
        presence.database.check()?;
        Ok(presence)
    }

    /// Compares the files on disk with their state when last seen. Call it before a commit. Cost:
    /// two `stat` calls.
    ///
    /// # Errors
    /// [`Trouble::Gone`]: a file was removed, replaced or truncated.
    pub(super) fn check(&mut self) -> Result<(), Trouble> {
        self.database.check()?;
        // SQLite creates the log with the first commit.
        if self.log.last.is_some() { self.log.check() } else { Ok(()) }
    }

    /// Like [`check`](Self::check), but for after a commit, when both files exist. Call it before
    /// anything in the commit is acknowledged.
    ///
    /// # Errors
    /// [`Trouble::Gone`].
    pub(super) fn check_committed(&mut self) -> Result<(), Trouble> {
        self.database.check()?;
        self.log.check()
    }
}

impl Watched {
    fn check(&mut self) -> Result<(), Trouble> {
        let now = fs::metadata(&self.path).map_err(|_| Trouble::Gone)?;
        let now = FileState::new(&now);
        if self.last.is_some_and(|last| !now.continues(last)) {
            return Err(Trouble::Gone);
        }
        self.last = Some(now);
        Ok(())
    }
}

impl FileState {
    fn new(metadata: &Metadata) -> Self {
        #[cfg(unix)]
        use std::os::unix::fs::MetadataExt;
        Self {
            #[cfg(unix)]
            identity: (metadata.dev(), metadata.ino()),
            len: metadata.len(),
        }
    }

    /// Whether this is the same file as `last`, and not shorter.
    fn continues(self, last: Self) -> bool {
        #[cfg(unix)]
        if self.identity != last.identity {
            return false;
        }
        self.len >= last.len
    }
}
