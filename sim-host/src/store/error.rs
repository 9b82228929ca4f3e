//! Why a store file can't be used, and what to do about it.

use std::path::{Path, PathBuf};

use rusqlite::ErrorCode;
use ubimap_protocol::units::Millimetres;

/// A store file that can't be used.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {trouble}", path = path.display())]
pub struct StoreError {
    /// The file's path.
    pub path: PathBuf,
    /// The reason.
    pub trouble: Trouble,
}

/// Why a store file can't be used.
#[derive(Debug, thiserror::Error)]
pub enum Trouble {
    /// It is not a database, or one of another program.
    #[error(
        "not a ubimap store, or its beginning is damaged; give the file of a store, restore a backup, or begin a new one under another name with --store"
    )]
    Foreign,
    /// It was written by another version of the program.
    #[error("written by another version of ubimap (schema {0}, this one has {SCHEMA}); use that version, or give another file with --store", SCHEMA = super::schema::SCHEMA)]
    Schema(i32),
    /// Its map has another cell size.
    #[error("holds a map with cells of {} m, but this run uses {} m; use the same cell size, or give another file with --store", .kept.metres(), .asked.metres())]
    Resolution {
        /// Side length of the cells in the file.
        kept: Millimetres,
        /// Side length of the cells in this run.
        asked: Millimetres,
    },
    /// It is a name or device that keeps nothing on disk.
    #[error("not a file on disk; give the path of a file with --store")]
    NotAFile,
    /// It was removed, replaced or truncated while it was open.
    #[error(
        "the file, or its -wal file, was removed, replaced or truncated while in use; nothing more is acknowledged as stored: restore both files, or give a new file with --store, and restart"
    )]
    Gone,
    /// Its contents are inconsistent.
    #[error("damaged: {0}; restore a backup, or give a new file with --store")]
    Damaged(&'static str),
    /// Its tables can't be read.
    #[error(
        "damaged, its tables can't be read: {0}; restore a backup, or give a new file with --store"
    )]
    Tables(rusqlite::Error),
    /// Some of its rows are damaged, so it is not copied.
    #[error(
        "{0} of its rows are damaged, so that no backup is made: an earlier one may be better; the next run with this --store leaves them out and asks the robots for their tiles"
    )]
    DamagedRows(usize),
    /// A backup would replace a file that is not an earlier backup.
    #[error(
        "exists and is not a backup, or is a store in use; give the name of a new file, or of an earlier backup"
    )]
    NotABackup,
    /// A finished backup can't be moved to its place.
    #[error(
        "can't write the backup: {0}; check the folder and its permissions, or give another file"
    )]
    Replace(std::io::Error),
    /// It can't be opened or created.
    #[error(
        "can't be opened or created; check the name, and that its folder exists and is writable"
    )]
    CannotOpen,
    /// It is not writable.
    #[error("not writable; check its permissions, or give another file with --store")]
    ReadOnly,
    /// It is on a file system that is mounted read-only.
    #[error("on a read-only file system; give a file elsewhere with --store")]
    ReadOnlyFileSystem,
    /// Another process has it open.
    #[error("in use by another process; stop that process, or give another file with --store")]
    InUse,
    /// The disk is full.
    #[error("the disk is full; free some space: nothing that was acknowledged as stored is lost")]
    Full,
    /// Any other database error.
    #[error("can't store the map: {0}")]
    Other(rusqlite::Error),
}

impl StoreError {
    /// The error for a file. SQLite reports a read-only file system as one of several errors, so
    /// the operating system is asked about it.
    pub(super) fn new(path: &Path, trouble: Trouble) -> Self {
        let may_be = matches!(trouble, Trouble::CannotOpen | Trouble::ReadOnly | Trouble::Other(_));
        let is_read_only = || {
            let folder = path.parent().filter(|it| !it.as_os_str().is_empty());
            let probe = if path.exists() { path } else { folder.unwrap_or(Path::new(".")) };
            is_on_read_only_file_system(probe)
        };
        let trouble = if may_be && is_read_only() { Trouble::ReadOnlyFileSystem } else { trouble };
        Self { path: path.to_owned(), trouble }
    }
}

#[cfg(target_os = "linux")]
fn is_on_read_only_file_system(path: &Path) -> bool {
    use nix::sys::statvfs::{FsFlags, statvfs};
    statvfs(path).is_ok_and(|system| system.flags().contains(FsFlags::ST_RDONLY))
}

#[cfg(not(target_os = "linux"))]
fn is_on_read_only_file_system(_: &Path) -> bool {
    false
}

impl Trouble {
    /// The same trouble, but [`Trouble::Tables`] instead of `Other`: for statements that can only
    /// fail if the tables are damaged.
    pub(super) fn in_tables(self) -> Self {
        match self {
            Self::Other(error) => Self::Tables(error),
            trouble => trouble,
        }
    }
}

impl From<rusqlite::Error> for Trouble {
    fn from(error: rusqlite::Error) -> Self {
        if let rusqlite::Error::FromSqlConversionFailure(..)
        | rusqlite::Error::IntegralValueOutOfRange(..)
        | rusqlite::Error::InvalidColumnType(..) = error
        {
            return Self::Damaged("a value is out of its range");
        }
        match error.sqlite_error_code() {
            Some(ErrorCode::NotADatabase) => Self::Foreign,
            Some(ErrorCode::DatabaseCorrupt) => Self::Damaged("the database is malformed"),
            Some(ErrorCode::CannotOpen) => Self::CannotOpen,
            Some(ErrorCode::ReadOnly | ErrorCode::PermissionDenied) => Self::ReadOnly,
            Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked) => Self::InUse,
            Some(ErrorCode::DiskFull) => Self::Full,
            _ => Self::Other(error),
        }
    }
}
