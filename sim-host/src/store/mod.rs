//! What the server must not lose, in one SQLite file: its epoch, its clock, and all that robots have
//! told.
//!
//! The file has one row about the server, one for each epoch of each tile of a robot, and one for
//! each tile with the times at which its cells were seen. It belongs to one process at a time.

mod error;

use std::path::{Path, PathBuf};

use rusqlite::{Connection, OpenFlags, OptionalExtension, Params, Row, Transaction, params};
use ubimap_protocol::{
    tile::{Epoch, Stamp, TILE_CELLS, TILE_SIDE, Tile, TileId, Version},
    time::Instant,
    units::{Millimetres, RobotId},
};

pub use error::{StoreError, Trouble};

use crate::mapping::TileRecord;

/// Tells a file of ours from those of other programs: "ubim".
const APPLICATION_ID: i32 = 0x7562_696D;
/// The version of the tables.
const SCHEMA: i32 = 1;
/// A tile as it lies in the file: its low plane's rows and then its high plane's, little-endian.
const TILE_LEN: usize = 8 * TILE_SIDE;

const TABLES: &str = "
    CREATE TABLE server (
        id INTEGER PRIMARY KEY CHECK (id = 1),
        resolution_mm INTEGER NOT NULL,
        epoch INTEGER NOT NULL,
        clock_us INTEGER NOT NULL
    ) STRICT;
    CREATE TABLE tile (
        robot INTEGER, x INTEGER, y INTEGER, epoch INTEGER,
        version INTEGER NOT NULL,
        cells BLOB NOT NULL,
        known BLOB NOT NULL,
        PRIMARY KEY (robot, x, y, epoch)
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE seen (
        robot INTEGER, x INTEGER, y INTEGER,
        seconds BLOB NOT NULL,
        PRIMARY KEY (robot, x, y)
    ) STRICT, WITHOUT ROWID;
";

/// The open file.
#[derive(Debug)]
pub struct Store {
    path: PathBuf,
    connection: Connection,
    epoch: Epoch,
    clock: Instant,
}

impl Store {
    /// Opens a file for a map of cells of this side; a file that is not there is made. Nothing is
    /// read of the map yet.
    ///
    /// # Errors
    /// [`StoreError`]: it can't be opened or written to, is no file of ours, or another map's.
    pub fn open(path: &Path, resolution: Millimetres) -> Result<Self, StoreError> {
        let wrap = |trouble| StoreError { path: path.to_owned(), trouble };
        let (connection, epoch, clock) = open(path, resolution).map_err(wrap)?;
        Ok(Self { path: path.to_owned(), connection, epoch, clock })
    }

    /// Begins a life of the server: a new epoch, of at least this number, which is on disk when
    /// this returns. No robot may be welcomed before.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn begin_life(&mut self, least: Epoch) -> Result<Epoch, StoreError> {
        let next = self.epoch.0.checked_add(1).map(|next| Epoch(next).max(least));
        let begun = next.ok_or(Trouble::Damaged("its epochs are used up")).and_then(|epoch| {
            self.connection.execute("UPDATE server SET epoch = ?", [epoch.0])?;
            Ok(epoch)
        });
        self.epoch = begun.map_err(|trouble| self.error(trouble))?;
        Ok(self.epoch)
    }

    /// The newest moment of the server's clock that the file knows: the clock goes on from there.
    pub fn clock(&self) -> Instant {
        self.clock
    }

    /// All that robots have told, the epochs of each tile in their order.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn records(&self) -> Result<Vec<(RobotId, TileRecord)>, StoreError> {
        let select = "SELECT robot, x, y, epoch, version, cells, known, seconds
                      FROM tile LEFT JOIN seen USING (robot, x, y) ORDER BY robot, x, y, epoch";
        let read = self.connection.prepare(select).map_err(Trouble::from).and_then(|mut all| {
            let mut rows = all.query([])?;
            let mut records = Vec::new();
            while let Some(row) = rows.next()? {
                records.push(record(row)?);
            }
            Ok(records)
        });
        read.map_err(|trouble| self.error(trouble))
    }

    /// Keeps records, all or none: they are on disk, for good, when this returns. `now` is by the
    /// server's clock.
    ///
    /// # Errors
    /// [`StoreError`]; the file is as it was.
    pub fn keep(
        &mut self,
        records: &[(RobotId, TileRecord)],
        now: Instant,
    ) -> Result<(), StoreError> {
        let clock = self.clock.max(now);
        let kept = self.connection.transaction().map_err(Trouble::from).and_then(|transaction| {
            write(&transaction, records, clock)?;
            Ok(transaction.commit()?)
        });
        kept.map_err(|trouble| self.error(trouble))?;
        self.clock = clock;
        Ok(())
    }

    /// Deletes the tiles of a robot of epochs below this one.
    ///
    /// # Errors
    /// [`StoreError`]; the file is as it was.
    pub fn retire(&mut self, robot: RobotId, first: Epoch) -> Result<(), StoreError> {
        let delete = "DELETE FROM tile WHERE robot = ? AND epoch < ?";
        let deleted = self.connection.execute(delete, params![robot.0, first.0]);
        deleted.map(drop).map_err(|trouble| self.error(trouble.into()))
    }

    fn error(&self, trouble: Trouble) -> StoreError {
        StoreError { path: self.path.clone(), trouble }
    }
}

fn open(path: &Path, resolution: Millimetres) -> Result<(Connection, Epoch, Instant), Trouble> {
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_CREATE;
    let mut connection = Connection::open_with_flags(path, flags)?;
    connection.busy_timeout(std::time::Duration::ZERO)?;
    // The file is ours alone; a commit is on disk, and not with the system only, when it returns.
    connection.pragma_update(None, "locking_mode", "exclusive")?;
    connection.pragma_update(None, "synchronous", "full")?;
    let transaction = connection.transaction()?;
    let number = |name: &str| -> Result<i32, Trouble> {
        Ok(transaction.pragma_query_value(None, name, |row| row.get(0))?)
    };
    let tables: u32 =
        transaction.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0))?;
    if tables == 0 {
        transaction.execute_batch(TABLES)?;
        transaction.pragma_update(None, "application_id", APPLICATION_ID)?;
        transaction.pragma_update(None, "user_version", SCHEMA)?;
        execute(&transaction, "INSERT INTO server VALUES (1, ?, 0, 0)", [resolution.0])?;
    } else if number("application_id")? != APPLICATION_ID {
        return Err(Trouble::Foreign);
    }
    let schema = number("user_version")?;
    if schema != SCHEMA {
        return Err(Trouble::Schema(schema));
    }
    let server = transaction
        .query_row("SELECT resolution_mm, epoch, clock_us FROM server", [], |row| {
            Ok((Millimetres(row.get(0)?), Epoch(row.get(1)?), row.get(2)?))
        })
        .optional()?;
    let (kept, epoch, clock): (_, _, i64) = server.ok_or(Trouble::Damaged("it has no server"))?;
    if kept != resolution {
        return Err(Trouble::Resolution { kept, asked: resolution });
    }
    let clock = u64::try_from(clock).map_err(|_| Trouble::Damaged("its clock is negative"))?;
    transaction.commit()?;
    // Only now: a file of another program stays as it is.
    connection.pragma_update(None, "journal_mode", "wal")?;
    Ok((connection, epoch, Instant(clock)))
}

fn write(
    transaction: &Transaction<'_>,
    records: &[(RobotId, TileRecord)],
    clock: Instant,
) -> Result<(), Trouble> {
    let clock = i64::try_from(clock.micros()).unwrap_or(i64::MAX);
    execute(transaction, "UPDATE server SET clock_us = ?", [clock])?;
    let mut tile = transaction.prepare("REPLACE INTO tile VALUES (?, ?, ?, ?, ?, ?, ?)")?;
    let mut seen = transaction.prepare("REPLACE INTO seen VALUES (?, ?, ?, ?)")?;
    for (robot, record) in records {
        let TileRecord { id, stamp, cells, known, seconds } = record;
        let (epoch, version) = (stamp.epoch.0, stamp.version.0);
        let (cells, known) = (tile_bytes(cells), tile_bytes(known));
        tile.execute(params![robot.0, id.x, id.y, epoch, version, cells, known])?;
        seen.execute(params![robot.0, id.x, id.y, bytes(seconds)])?;
    }
    Ok(())
}

fn execute(
    transaction: &Transaction<'_>,
    statement: &str,
    parameters: impl Params,
) -> Result<(), Trouble> {
    transaction.execute(statement, parameters)?;
    Ok(())
}

fn record(row: &Row<'_>) -> Result<(RobotId, TileRecord), Trouble> {
    let seconds = row.get_ref(7)?.as_blob().ok().and_then(words::<{ TILE_CELLS as usize }>);
    let record = TileRecord {
        id: TileId { x: row.get(1)?, y: row.get(2)? },
        stamp: Stamp { epoch: Epoch(row.get(3)?), version: Version(row.get(4)?) },
        cells: tile(row, 5)?,
        known: tile(row, 6)?,
        seconds: seconds.ok_or(Trouble::Damaged("the times of a tile are not 4,096 bytes"))?,
    };
    Ok((RobotId(row.get(0)?), record))
}

fn tile(row: &Row<'_>, column: usize) -> Result<Tile, Trouble> {
    let planes = row.get_ref(column)?.as_blob().ok().and_then(|planes| {
        let (low, high) = planes.split_at_checked(TILE_LEN / 2)?;
        Some(Tile { low: words(low)?, high: words(high)? })
    });
    planes.ok_or(Trouble::Damaged("a tile is not 256 bytes"))
}

fn tile_bytes(tile: &Tile) -> Vec<u8> {
    [bytes(&tile.low), bytes(&tile.high)].concat()
}

fn bytes(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// The inverse of [`bytes`], if there are so many words.
fn words<const COUNT: usize>(bytes: &[u8]) -> Option<[u32; COUNT]> {
    let (words, rest) = bytes.as_chunks();
    let words: &[[u8; 4]; COUNT] = words.try_into().ok()?;
    rest.is_empty().then(|| words.map(u32::from_le_bytes))
}

#[cfg(test)]
mod tests;
