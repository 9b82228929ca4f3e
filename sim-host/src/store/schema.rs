//! Opens a store's file: creates its tables, upgrades those of earlier versions, and checks the
//! contents.

use std::{fs::File, path::Path, time::Duration};

use rusqlite::{
    Connection, OpenFlags, OptionalExtension, Transaction, TransactionBehavior, config::DbConfig,
    types::Value,
};
use ubimap_protocol::{tile::Epoch, time::Instant, units::Millimetres};

use super::{
    Trouble,
    damage::Damage,
    lock::lock,
    log,
    rows::{self, CAMERA, CURED, PLACEMENT, SEEN, SERVER, TILE},
};

/// SQLite application id: "ubim".
pub(super) const APPLICATION_ID: i32 = 0x7562_696D;
/// Version of the tables.
pub(super) const SCHEMA: i32 = 5;
/// No robot reaches this epoch. Earlier versions of the server accepted tiles of this epoch or
/// later ones. These are deleted when the file is opened, because no epochs would be left for the
/// robot's new tiles.
pub(super) const END_OF_EPOCHS: u32 = 1 << 31;

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

/// Added by schema 4, with the checksums of all rows; older files are upgraded when opened.
const TABLES_4: &str = "
    ALTER TABLE server ADD COLUMN crc INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE tile ADD COLUMN crc INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE seen ADD COLUMN crc INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE camera ADD COLUMN crc INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE cured ADD COLUMN crc INTEGER NOT NULL DEFAULT 0;
";

/// Added by schema 5; older files are upgraded when opened.
const TABLES_5: &str = "
    CREATE TABLE placement (
        robot INTEGER PRIMARY KEY,
        corrections BLOB NOT NULL,
        ground BLOB NOT NULL,
        crc INTEGER NOT NULL DEFAULT 0
    ) STRICT;
";

/// Timeout for another process that reads or closes the file.
const BUSY_WAIT: Duration = Duration::from_secs(2);

/// An open file, checked.
pub(super) struct Opened {
    pub(super) connection: Connection,
    pub(super) lock: File,
    pub(super) server: ServerRow,
    pub(super) damage: Vec<Damage>,
}

/// The row of the table `server`.
#[derive(Clone, Copy, Debug)]
pub(super) struct ServerRow {
    pub(super) resolution: Millimetres,
    /// The epoch of the server's newest life.
    pub(super) epoch: Epoch,
    pub(super) clock: Instant,
}

impl ServerRow {
    /// Replaces the row on disk.
    pub(super) fn write(self, connection: &Connection) -> Result<(), Trouble> {
        let clock = i64::try_from(self.clock.micros()).unwrap_or(i64::MAX);
        let Self { resolution, epoch, .. } = self;
        SERVER.write(connection, vec![1.into(), resolution.0.into(), epoch.0.into(), clock.into()])
    }

    fn read(connection: &Connection) -> Result<Self, Trouble> {
        let select = "SELECT resolution_mm, epoch, clock_us FROM server";
        let row = connection.query_row(select, [], |row| {
            Ok((Millimetres(row.get(0)?), Epoch(row.get(1)?), row.get::<_, i64>(2)?))
        });
        let (resolution, epoch, clock) =
            row.optional()?.ok_or(Trouble::Damaged("its server row is missing"))?;
        let clock = u64::try_from(clock).map_err(|_| Trouble::Damaged("its clock is negative"))?;
        Ok(Self { resolution, epoch, clock: Instant(clock) })
    }
}

/// Opens the file of a map whose cells have the side length `resolution`, for exclusive use.
/// Creates it if it does not exist. Deletes damaged rows. Reads the whole file.
pub(super) fn open(path: &Path, resolution: Millimetres) -> Result<Opened, Trouble> {
    let mut connection = connect(path, OpenFlags::SQLITE_OPEN_CREATE)?;
    check_owner(&connection).map_err(Trouble::in_tables)?;
    // Locked only now, so that no file is created beside a file of another program.
    let lock = lock(path)?;
    let log_damage = log::is_damaged(path).then_some(Damage::Log);
    // A commit returns only after the data is on disk.
    connection.pragma_update(None, "synchronous", "full")?;
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    prepare(&transaction, resolution).map_err(Trouble::in_tables)?;
    check_pages(&transaction)?;
    let mut damage = remove_damaged(&transaction).map_err(Trouble::in_tables)?;
    damage.extend(log_damage);
    transaction.execute("DELETE FROM tile WHERE epoch >= ?", [END_OF_EPOCHS])?;
    let server = ServerRow::read(&transaction)?;
    if server.resolution != resolution {
        return Err(Trouble::Resolution { kept: server.resolution, asked: resolution });
    }
    transaction.commit()?;
    connection.pragma_update(None, "journal_mode", "wal")?;
    Ok(Opened { connection, lock, server, damage })
}

/// Connects to a file for reading and writing.
pub(super) fn connect(path: &Path, flags: OpenFlags) -> Result<Connection, Trouble> {
    check_name(path)?;
    let flags = OpenFlags::SQLITE_OPEN_READ_WRITE | flags;
    let connection = Connection::open_with_flags(path, flags)?;
    // The file may be from an untrusted source, so no code in its schema may be executed.
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_DEFENSIVE, true)?;
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_TRUSTED_SCHEMA, false)?;
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_ENABLE_TRIGGER, false)?;
    connection.set_db_config(DbConfig::SQLITE_DBCONFIG_ENABLE_VIEW, false)?;
    connection.busy_timeout(BUSY_WAIT)?;
    Ok(connection)
}

/// Refuses names that SQLite does not treat as a file on disk.
fn check_name(path: &Path) -> Result<(), Trouble> {
    let name = path.as_os_str().as_encoded_bytes();
    if name.is_empty() || name == b":memory:" || name.starts_with(b"file:") {
        return Err(Trouble::NotAFile);
    }
    match path.metadata() {
        Ok(metadata) if !metadata.is_file() && !metadata.is_dir() => Err(Trouble::NotAFile),
        // SQLite reports its own error for a folder, and can create a file that does not exist yet.
        _ => Ok(()),
    }
}

/// Refuses files of other programs. Returns whether the file is empty.
pub(super) fn check_owner(connection: &Connection) -> Result<bool, Trouble> {
    let count = "SELECT count(*) FROM sqlite_schema";
    let tables: u32 = connection.query_row(count, [], |row| row.get(0))?;
    if tables > 0 && number(connection, "application_id")? != APPLICATION_ID {
        return Err(Trouble::Foreign);
    }
    Ok(tables == 0)
}

fn number(connection: &Connection, name: &str) -> Result<i32, Trouble> {
    Ok(connection.pragma_query_value(None, name, |row| row.get(0))?)
}

/// Refuses files of later versions. Returns whether the file has the current version, so that its
/// rows have checksums.
pub(super) fn check_schema(connection: &Connection) -> Result<bool, Trouble> {
    match number(connection, "user_version")? {
        SCHEMA => Ok(true),
        1..SCHEMA => Ok(false),
        schema => Err(Trouble::Schema(schema)),
    }
}

/// Creates the tables, or upgrades them.
fn prepare(transaction: &Transaction<'_>, resolution: Millimetres) -> Result<(), Trouble> {
    if check_owner(transaction)? {
        transaction.execute_batch(TABLES)?;
        transaction.pragma_update(None, "application_id", APPLICATION_ID)?;
        transaction.pragma_update(None, "user_version", 1)?;
        transaction.execute("INSERT INTO server VALUES (1, ?, 0, 0)", [resolution.0])?;
    }
    let missing: &[&str] = match number(transaction, "user_version")? {
        SCHEMA => return Ok(()),
        4 => &[TABLES_5],
        3 => &[TABLES_4, TABLES_5],
        2 => &[TABLES_3, TABLES_4, TABLES_5],
        1 => &[TABLES_2, TABLES_3, TABLES_4, TABLES_5],
        schema => return Err(Trouble::Schema(schema)),
    };
    // Rows of the first versions have no checksums, so only this check can detect damage.
    check_pages(transaction)?;
    missing.iter().try_for_each(|tables| transaction.execute_batch(tables))?;
    if missing.contains(&TABLES_4) {
        rows::ALL.iter().try_for_each(|table| table.seal(transaction))?;
    }
    Ok(transaction.pragma_update(None, "user_version", SCHEMA)?)
}

/// Checks the structure of the file, since damage there could hide whole rows. Reads the whole
/// file.
pub(super) fn check_pages(connection: &Connection) -> Result<(), Trouble> {
    let mut statement = connection.prepare("PRAGMA integrity_check")?;
    let mut found = statement.query([])?;
    while let Some(row) = found.next()? {
        let text: String = row.get(0)?;
        // A value of the wrong type is ignored here: the row's checksum detects it.
        if text != "ok" && !text.contains(" value in ") {
            ::log::debug!("integrity check: {text}");
            return Err(Trouble::Damaged("the database is malformed"));
        }
    }
    Ok(())
}

/// Deletes the damaged rows. A damaged `server` row is an error, because it can't be restored.
fn remove_damaged(transaction: &Transaction<'_>) -> Result<Vec<Damage>, Trouble> {
    if !SERVER.damaged(transaction)?.is_empty() {
        return Err(Trouble::Damaged("its server row is malformed"));
    }
    let mut damage = Vec::new();
    for (table, kind) in [
        (&TILE, Damage::tile as fn(&[Value]) -> Damage),
        (&SEEN, Damage::times),
        (&CAMERA, Damage::camera_tile),
        (&CURED, Damage::cure),
        (&PLACEMENT, Damage::placement),
    ] {
        damage.extend(table.remove_damaged(transaction)?.iter().map(|key| kind(key)));
    }
    Ok(damage)
}
