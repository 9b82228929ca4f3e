//! The server's persistent state in one SQLite file: its epoch, its clock, the tiles of robots and
//! cameras, and which robots' constant errors are corrected.
//!
//! Tables: `server` has one row; `tile` one per robot, tile and epoch; `seen` one per robot and
//! tile, with the time each cell was last seen; `camera` one per tile seen by cameras; `cured` one
//! per robot whose correction has begun. The file belongs to one process at a time.

mod error;
mod presence;

use std::path::{Path, PathBuf};

use presence::Presence;
use rusqlite::{
    Connection, OpenFlags, OptionalExtension, Params, Row, Transaction, config::DbConfig, params,
};
use ubimap_protocol::{
    tile::{Epoch, Stamp, TILE_CELLS, TILE_SIDE, Tile, TileId, Version},
    time::Instant,
    units::{Millimetres, RobotId},
};

pub use error::{StoreError, Trouble};

use crate::mapping::{CameraTile, CureRecord, Cured, SeenTile, TileRecord};

/// SQLite application id: "ubim".
const APPLICATION_ID: i32 = 0x7562_696D;
/// Version of the tables.
const SCHEMA: i32 = 3;
/// Bytes of a stored tile: the rows of its low plane, then those of its high plane, little-endian.
const TILE_LEN: usize = 8 * TILE_SIDE;
/// No robot reaches this epoch: tiles of later ones, which earlier versions of the server accepted,
/// are deleted when the file is opened, because they would leave the robot no epochs.
const END_OF_EPOCHS: u32 = 1 << 31;

/// Tables of schema 1.
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

/// Added by schema 2; older files are upgraded when opened.
const TABLES_2: &str = "
    CREATE TABLE camera (
        x INTEGER, y INTEGER,
        cells BLOB NOT NULL,
        seconds BLOB NOT NULL,
        cameras BLOB NOT NULL,
        PRIMARY KEY (x, y)
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE cured (
        robot INTEGER PRIMARY KEY,
        first_epoch INTEGER NOT NULL,
        identifier_deg REAL NOT NULL,
        sensor_deg REAL NOT NULL
    ) STRICT;
";
/// Added by schema 3; older files are upgraded when opened.
const TABLES_3: &str = "ALTER TABLE cured ADD COLUMN is_over INTEGER NOT NULL DEFAULT 1";

/// The open file.
#[derive(Debug)]
pub struct Store {
    path: PathBuf,
    connection: Connection,
    presence: Presence,
    epoch: Epoch,
    clock: Instant,
}

impl Store {
    /// Opens the file of a map with cells of the given side length; creates it if it does not
    /// exist. Reads no tiles.
    ///
    /// # Errors
    /// [`StoreError`]: the file can't be opened or written, or is not a store of such a map.
    pub fn open(path: &Path, resolution: Millimetres) -> Result<Self, StoreError> {
        let wrap = |trouble| StoreError::new(path, trouble);
        let (connection, epoch, clock) = open(path, resolution).map_err(wrap)?;
        let presence = Presence::new(path).map_err(wrap)?;
        Ok(Self { path: path.to_owned(), connection, presence, epoch, clock })
    }

    /// Starts a life of the server in the epoch `drawn`, which should be random, or in the next one
    /// if that is zero or the epoch of the last life. It is on disk when this returns. Call it
    /// before any robot is welcomed.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn begin_life(&mut self, drawn: Epoch) -> Result<Epoch, StoreError> {
        let mut epoch = drawn;
        while epoch == Epoch(0) || epoch == self.epoch {
            epoch.0 = epoch.0.wrapping_add(1);
        }
        let written = self.connection.execute("UPDATE server SET epoch = ?", [epoch.0]);
        let written = written.map_err(Trouble::from).and_then(|_| self.presence.check_committed());
        written.map_err(|trouble| self.error(trouble))?;
        self.epoch = epoch;
        Ok(epoch)
    }

    /// The path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The last stored time of the server's clock, which continues from there.
    pub fn clock(&self) -> Instant {
        self.clock
    }

    /// Reads all robots' tiles; the epochs of each tile in ascending order.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn records(&self) -> Result<Vec<(RobotId, TileRecord)>, StoreError> {
        let select = "SELECT robot, x, y, epoch, version, cells, known, seconds
                      FROM tile LEFT JOIN seen USING (robot, x, y) ORDER BY robot, x, y, epoch";
        self.select(select, record)
    }

    /// Reads all camera tiles, ordered by tile.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn camera_tiles(&self) -> Result<Vec<CameraTile>, StoreError> {
        self.select("SELECT x, y, cells, seconds, cameras FROM camera ORDER BY x, y", camera_tile)
    }

    /// Reads the progress of the robots' cures.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn cured(&self) -> Result<Vec<CureRecord>, StoreError> {
        let select = "SELECT robot, identifier_deg, sensor_deg, first_epoch, is_over FROM cured
                      ORDER BY robot";
        self.select(select, |row| {
            Ok(CureRecord {
                robot: RobotId(row.get(0)?),
                cured: Cured { taken_out: row.get(1)?, added: row.get(2)? },
                first_epoch: Epoch(row.get(3)?),
                is_over: row.get(4)?,
            })
        })
    }

    fn select<T>(
        &self,
        statement: &str,
        read: impl Fn(&Row<'_>) -> Result<T, Trouble>,
    ) -> Result<Vec<T>, StoreError> {
        let all = self.connection.prepare(statement).map_err(Trouble::from);
        let all = all.and_then(|mut statement| {
            let mut rows = statement.query([])?;
            let mut all = Vec::new();
            while let Some(row) = rows.next()? {
                all.push(read(row)?);
            }
            Ok(all)
        });
        all.map_err(|trouble| self.error(trouble))
    }

    /// Writes records in one transaction, which is durably on disk when this returns. `now` is by
    /// the server's clock.
    ///
    /// # Errors
    /// [`StoreError`]; nothing of it may be acknowledged. The file is unchanged, unless it is
    /// [gone](Trouble::Gone).
    pub fn keep(
        &mut self,
        records: &[(RobotId, TileRecord)],
        now: Instant,
    ) -> Result<(), StoreError> {
        let clock = self.clock.max(now);
        self.write(|transaction| write(transaction, records, clock))?;
        self.clock = clock;
        Ok(())
    }

    /// Replaces camera tiles in one transaction.
    ///
    /// # Errors
    /// [`StoreError`]; nothing of it may be acknowledged. The file is unchanged, unless it is
    /// [gone](Trouble::Gone).
    pub fn keep_camera_tiles(
        &mut self,
        tiles: &[CameraTile],
        now: Instant,
    ) -> Result<(), StoreError> {
        let clock = self.clock.max(now);
        self.write(|transaction| write_camera_tiles(transaction, tiles, clock))?;
        self.clock = clock;
        Ok(())
    }

    /// Stores the progress of a robot's cure, and deletes its void tiles.
    ///
    /// # Errors
    /// [`StoreError`]; nothing of it may be acknowledged. The file is unchanged, unless it is
    /// [gone](Trouble::Gone).
    pub fn cure(&mut self, record: &CureRecord) -> Result<(), StoreError> {
        let CureRecord { robot, cured, first_epoch, is_over } = *record;
        self.write(|transaction| {
            let delete = "DELETE FROM tile WHERE robot = ? AND epoch < ?";
            execute(transaction, delete, params![robot.0, first_epoch.0])?;
            let row = params![robot.0, first_epoch.0, cured.taken_out, cured.added, is_over];
            execute(transaction, "REPLACE INTO cured VALUES (?, ?, ?, ?, ?)", row)
        })
    }

    fn write(
        &mut self,
        all: impl FnOnce(&Transaction<'_>) -> Result<(), Trouble>,
    ) -> Result<(), StoreError> {
        let kept = self.presence.check().and_then(|()| {
            let transaction = self.connection.transaction()?;
            all(&transaction)?;
            transaction.commit()?;
            self.presence.check_committed()
        });
        kept.map_err(|trouble| self.error(trouble))
    }

    /// Limits the file's length, as a full disk does.
    #[cfg(test)]
    pub(crate) fn limit_pages(&self, pages: u32) {
        self.connection.pragma_update(None, "max_page_count", pages).unwrap();
    }

    fn error(&self, trouble: Trouble) -> StoreError {
        StoreError::new(&self.path, trouble)
    }
}

fn open(path: &Path, resolution: Millimetres) -> Result<(Connection, Epoch, Instant), Trouble> {
    check_name(path)?;
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | OpenFlags::SQLITE_OPEN_CREATE;
    let mut connection = Connection::open_with_flags(path, flags)?;
    // The file may come from a stranger: nothing that its schema contains is executed.
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_DEFENSIVE, true)?;
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_TRUSTED_SCHEMA, false)?;
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_ENABLE_TRIGGER, false)?;
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_ENABLE_VIEW, false)?;
    connection.busy_timeout(std::time::Duration::ZERO)?;
    // Exclusive access; a commit returns only after the data is on disk.
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
        transaction.pragma_update(None, "user_version", 1)?;
        execute(&transaction, "INSERT INTO server VALUES (1, ?, 0, 0)", [resolution.0])?;
    } else if number("application_id")? != APPLICATION_ID {
        return Err(Trouble::Foreign);
    }
    let missing: &[&str] = match number("user_version")? {
        SCHEMA => &[],
        2 => &[TABLES_3],
        1 => &[TABLES_2, TABLES_3],
        schema => return Err(Trouble::Schema(schema)),
    };
    for tables in missing {
        transaction.execute_batch(tables)?;
        transaction.pragma_update(None, "user_version", SCHEMA)?;
    }
    execute(&transaction, "DELETE FROM tile WHERE epoch >= ?", [END_OF_EPOCHS])?;
    let server = transaction
        .query_row("SELECT resolution_mm, epoch, clock_us FROM server", [], |row| {
            Ok((Millimetres(row.get(0)?), Epoch(row.get(1)?), row.get(2)?))
        })
        .optional()?;
    let (kept, epoch, clock): (_, _, i64) =
        server.ok_or(Trouble::Damaged("its server row is missing"))?;
    if kept != resolution {
        return Err(Trouble::Resolution { kept, asked: resolution });
    }
    let clock = u64::try_from(clock).map_err(|_| Trouble::Damaged("its clock is negative"))?;
    transaction.commit()?;
    // Last, so that files of other programs are not modified.
    connection.pragma_update(None, "journal_mode", "wal")?;
    Ok((connection, epoch, Instant(clock)))
}

/// Refuses names that SQLite does not take for a file on disk.
fn check_name(path: &Path) -> Result<(), Trouble> {
    let name = path.as_os_str().as_encoded_bytes();
    if name.is_empty() || name == b":memory:" || name.starts_with(b"file:") {
        return Err(Trouble::NotAFile);
    }
    match path.metadata() {
        Ok(metadata) if !metadata.is_file() && !metadata.is_dir() => Err(Trouble::NotAFile),
        // A folder, or a file that does not exist yet, is SQLite's to judge.
        _ => Ok(()),
    }
}

fn write(
    transaction: &Transaction<'_>,
    records: &[(RobotId, TileRecord)],
    clock: Instant,
) -> Result<(), Trouble> {
    write_clock(transaction, clock)?;
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

fn write_camera_tiles(
    transaction: &Transaction<'_>,
    tiles: &[CameraTile],
    clock: Instant,
) -> Result<(), Trouble> {
    write_clock(transaction, clock)?;
    let mut row = transaction.prepare("REPLACE INTO camera VALUES (?, ?, ?, ?, ?)")?;
    for CameraTile { id, seen, cameras } in tiles {
        let cells = tile_bytes(&seen.tile);
        row.execute(params![id.x, id.y, cells, bytes(&seen.seconds), bytes(cameras)])?;
    }
    Ok(())
}

fn write_clock(transaction: &Transaction<'_>, clock: Instant) -> Result<(), Trouble> {
    let clock = i64::try_from(clock.micros()).unwrap_or(i64::MAX);
    execute(transaction, "UPDATE server SET clock_us = ?", [clock])
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
    let record = TileRecord {
        id: TileId { x: row.get(1)?, y: row.get(2)? },
        stamp: Stamp { epoch: Epoch(row.get(3)?), version: Version(row.get(4)?) },
        cells: tile(row, 5)?,
        known: tile(row, 6)?,
        seconds: cells(row, 7)?,
    };
    Ok((RobotId(row.get(0)?), record))
}

fn camera_tile(row: &Row<'_>) -> Result<CameraTile, Trouble> {
    Ok(CameraTile {
        id: TileId { x: row.get(0)?, y: row.get(1)? },
        seen: SeenTile { tile: tile(row, 2)?, seconds: cells(row, 3)? },
        cameras: cells(row, 4)?,
    })
}

/// Reads a column with one number per cell of a tile.
fn cells(row: &Row<'_>, column: usize) -> Result<[u32; TILE_CELLS as usize], Trouble> {
    let numbers = row.get_ref(column)?.as_blob().ok().and_then(words);
    numbers.ok_or(Trouble::Damaged("the times or cameras of a tile do not have 4,096 bytes"))
}

fn tile(row: &Row<'_>, column: usize) -> Result<Tile, Trouble> {
    let planes = row.get_ref(column)?.as_blob().ok().and_then(|planes| {
        let (low, high) = planes.split_at_checked(TILE_LEN / 2)?;
        Some(Tile { low: words(low)?, high: words(high)? })
    });
    planes.ok_or(Trouble::Damaged("a tile does not have 256 bytes"))
}

fn tile_bytes(tile: &Tile) -> Vec<u8> {
    [bytes(&tile.low), bytes(&tile.high)].concat()
}

fn bytes(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|word| word.to_le_bytes()).collect()
}

/// The inverse of [`bytes`]; `None` unless there are `COUNT` words.
fn words<const COUNT: usize>(bytes: &[u8]) -> Option<[u32; COUNT]> {
    let (words, rest) = bytes.as_chunks();
    let words: &[[u8; 4]; COUNT] = words.try_into().ok()?;
    rest.is_empty().then(|| words.map(u32::from_le_bytes))
}

#[cfg(test)]
mod tests;
