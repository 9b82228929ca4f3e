//! Why a file can't keep a map, and what to do about it.

use std::path::PathBuf;

use rusqlite::ErrorCode;
use ubimap_protocol::units::Millimetres;

/// A file that can't keep the map.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {trouble}", path = path.display())]
pub struct StoreError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it.
    pub trouble: Trouble,
}

/// What is wrong with a file.
#[derive(Debug, thiserror::Error)]
pub enum Trouble {
    /// It is no database, or one of another program.
    #[error("no file of ubimap's; name another one with --store, or a new one")]
    Foreign,
    /// Another version of the program wrote it.
    #[error("written by another version of ubimap (schema {0}, this one has {SCHEMA}); use that version, or name another file with --store", SCHEMA = super::SCHEMA)]
    Schema(i32),
    /// It holds a map of other cells.
    #[error("holds a map with cells of {} m, and this run has {} m; choose the same cells, or name another file with --store", .kept.metres(), .asked.metres())]
    Resolution {
        /// The side of the cells in the file.
        kept: Millimetres,
        /// The side that was asked for.
        asked: Millimetres,
    },
    /// What it holds can't be.
    #[error("damaged: {0}; restore a copy of it, or name a new file with --store")]
    Damaged(&'static str),
    /// It can't be opened.
    #[error("can't be opened or made; see that its folder is there and may be written to")]
    CannotOpen,
    /// It can't be written to.
    #[error("can't be written to; see to its permissions, or name another file with --store")]
    ReadOnly,
    /// Another process has it open.
    #[error("in use by another process; end that one, or name another file with --store")]
    InUse,
    /// There is no room for what is new.
    #[error("the disk is full; make room and start again: nothing that was acknowledged is lost")]
    Full,
    /// Something else.
    #[error("can't keep the map: {0}")]
    Other(rusqlite::Error),
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
