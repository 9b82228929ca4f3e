//! The server's persistent state in one SQLite file: its epoch, its clock, the tiles of robots and
//! cameras, and which robots' constant errors are corrected.
//!
//! The table `server` has one row. `tile` has one row per robot, tile and epoch, at most three for
//! each tile of a robot: its closed epochs are joined in one row with version 0. `seen` has one row
//! per robot and tile, with the time at which each cell was last reported. `camera` has one row per
//! tile seen by cameras, `cured` one per robot whose correction has begun, and `placement` one per robot that
//! was found to have drawn at wrong poses. Each row has a checksum. Only one process at a time can open the file.
//!
//! | file | content |
//! |---|---|
//! | `schema` | the tables; opening, upgrading and checking a file |
//! | `placement` | the bytes of a robot's corrections and of the ground that it saw |
//! | `rows`, `damage` | rows with checksums, and those that were damaged |
//! | `log` | damage of SQLite's log |
//! | `lock`, `presence` | exclusive use, and checks that the files are still there |
//! | `backup` | copies of a file in use |
//! | `error` | why a file can't be used |

mod backup;
mod damage;
mod error;
mod lock;
mod log;
mod placement;
mod presence;
mod rows;
mod schema;

use std::{
    fs::File,
    path::{Path, PathBuf},
};

use presence::Presence;
use rows::{CAMERA, CURED, PLACEMENT, SEEN, TILE};
use rusqlite::{Connection, Row, Transaction, types::ValueRef};
use schema::{Opened, ServerRow};
use ubimap_protocol::{
    tile::{Epoch, Stamp, TILE_CELLS, TILE_SIDE, Tile, TileId, Version},
    time::Instant,
    units::{Millimetres, RobotId},
};

pub use backup::backup;
pub use damage::Damage;
pub use error::{StoreError, Trouble};

use crate::mapping::{CameraTile, CureRecord, Cured, Placement, SeenTile, TileRecord};

/// Bytes of a stored tile: the rows of its low plane, then those of its high plane, little-endian.
const TILE_LEN: usize = 8 * TILE_SIDE;

/// An open store file.
#[derive(Debug)]
pub struct Store {
    path: PathBuf,
    connection: Connection,
    presence: Presence,
    server: ServerRow,
    damage: Vec<Damage>,
    /// Held until the connection is closed.
    _lock: File,
}

impl Store {
    /// Opens the file of a map with cells of the given side length; creates it if it does not
    /// exist. Deletes damaged rows, which [`Store::damage`] then names. Cost: reads the whole file.
    ///
    /// # Errors
    /// [`StoreError`]: the file can't be opened or written, or is not a store of such a map.
    pub fn open(path: &Path, resolution: Millimetres) -> Result<Self, StoreError> {
        let wrap = |trouble| StoreError::new(path, trouble);
        let Opened { connection, lock, server, damage } =
            schema::open(path, resolution).map_err(wrap)?;
        let presence = Presence::new(path).map_err(wrap)?;
        Ok(Self { path: path.to_owned(), connection, presence, server, damage, _lock: lock })
    }

    /// The damaged rows that were deleted when the file was opened.
    pub fn damage(&self) -> &[Damage] {
        &self.damage
    }

    /// Starts a life (a run) of the server. Its epoch is `drawn`, which should be random, or the
    /// next one if `drawn` is zero or the epoch of the last life. Returns the epoch, which is then
    /// on disk. Call this before any robot gets a session.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn begin_life(&mut self, drawn: Epoch) -> Result<Epoch, StoreError> {
        let mut epoch = drawn;
        while epoch == Epoch(0) || epoch == self.server.epoch {
            epoch.0 = epoch.0.wrapping_add(1);
        }
        self.write(ServerRow { epoch, ..self.server }, |_| Ok(()))?;
        Ok(epoch)
    }

    /// The path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The last stored time of the server's clock; the clock of the next life continues from it.
    pub fn clock(&self) -> Instant {
        self.server.clock
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

    /// Reads the progress of the robots' cures (corrections of their constant errors).
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

    /// Reads what is known of where robots were.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn placements(&self) -> Result<Vec<(RobotId, Placement)>, StoreError> {
        self.select("SELECT robot, corrections, ground FROM placement ORDER BY robot", |row| {
            let (corrections, ground): (Vec<u8>, Vec<u8>) = (row.get(1)?, row.get(2)?);
            Ok((RobotId(row.get(0)?), placement::read(&corrections, &ground)))
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

    /// Writes records in one transaction, which is durably on disk when this returns. A
    /// [closed](TileRecord::is_closed) record replaces those of all epochs up to its own. `now` is
    /// by the server's clock.
    ///
    /// # Errors
    /// [`StoreError`]; none of it may be acknowledged as stored. The file is unchanged, unless it
    /// is [gone](Trouble::Gone).
    pub fn keep(
        &mut self,
        records: &[(RobotId, TileRecord)],
        now: Instant,
    ) -> Result<(), StoreError> {
        self.write(self.server_at(now), |transaction| write(transaction, records))
    }

    /// Replaces camera tiles in one transaction. `now` is by the server's clock.
    ///
    /// # Errors
    /// [`StoreError`]; none of it may be acknowledged as stored. The file is unchanged, unless it
    /// is [gone](Trouble::Gone).
    pub fn keep_camera_tiles(
        &mut self,
        tiles: &[CameraTile],
        now: Instant,
    ) -> Result<(), StoreError> {
        self.write(self.server_at(now), |transaction| write_camera_tiles(transaction, tiles))
    }

    /// Stores the progress of a robot's cure, and deletes the robot's void tiles.
    ///
    /// # Errors
    /// [`StoreError`]; none of it may be acknowledged as stored. The file is unchanged, unless it
    /// is [gone](Trouble::Gone).
    pub fn cure(&mut self, record: &CureRecord) -> Result<(), StoreError> {
        let CureRecord { robot, cured: Cured { taken_out, added }, first_epoch, is_over } = *record;
        self.write(self.server, |transaction| {
            let delete = "DELETE FROM tile WHERE robot = ? AND epoch < ?";
            transaction.execute(delete, [u32::from(robot.0), first_epoch.0])?;
            // SQLite does not keep the sign of a zero.
            let [taken_out, added] = [taken_out, added].map(|degrees| degrees + 0.0);
            let row = vec![
                robot.0.into(),
                first_epoch.0.into(),
                taken_out.into(),
                added.into(),
                is_over.into(),
            ];
            CURED.write(transaction, row)
        })
    }

    /// Replaces the placements of these robots in one transaction. `now` is by the server's clock.
    ///
    /// # Errors
    /// [`StoreError`]. The file is unchanged, unless it is [gone](Trouble::Gone).
    pub fn keep_placements(
        &mut self,
        placements: &[(RobotId, Placement)],
        now: Instant,
    ) -> Result<(), StoreError> {
        self.write(self.server_at(now), |transaction| {
            placements.iter().try_for_each(|(robot, it)| {
                let [corrections, ground] = placement::bytes(it);
                PLACEMENT
                    .write(transaction, vec![robot.0.into(), corrections.into(), ground.into()])
            })
        })
    }

    /// The `server` row at a time of the server's clock, which is monotonic.
    fn server_at(&self, now: Instant) -> ServerRow {
        ServerRow { clock: self.server.clock.max(now), ..self.server }
    }

    fn write(
        &mut self,
        server: ServerRow,
        all: impl FnOnce(&Transaction<'_>) -> Result<(), Trouble>,
    ) -> Result<(), StoreError> {
        let kept = self.presence.check().and_then(|()| {
            let transaction = self.connection.transaction()?;
            server.write(&transaction)?;
            all(&transaction)?;
            transaction.commit()?;
            self.presence.check_committed()
        });
        kept.map_err(|trouble| self.error(trouble))?;
        self.server = server;
        Ok(())
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

fn write(transaction: &Transaction<'_>, records: &[(RobotId, TileRecord)]) -> Result<(), Trouble> {
    let (mut tile, mut seen) = (TILE.writer(transaction)?, SEEN.writer(transaction)?);
    let delete = "DELETE FROM tile WHERE robot = ? AND x = ? AND y = ? AND epoch <= ?";
    let mut delete = transaction.prepare(delete)?;
    for (robot, record) in records {
        let TileRecord { id, stamp, cells, known, seconds } = record;
        let [robot, x, y] = [i64::from(robot.0), id.x.into(), id.y.into()];
        if record.is_closed() {
            delete.execute([robot, x, y, stamp.epoch.0.into()])?;
        }
        tile.write(vec![
            robot.into(),
            x.into(),
            y.into(),
            stamp.epoch.0.into(),
            stamp.version.0.into(),
            tile_bytes(cells).into(),
            tile_bytes(known).into(),
        ])?;
        seen.write(vec![robot.into(), x.into(), y.into(), bytes(seconds).into()])?;
    }
    Ok(())
}

fn write_camera_tiles(transaction: &Transaction<'_>, tiles: &[CameraTile]) -> Result<(), Trouble> {
    let mut row = CAMERA.writer(transaction)?;
    for CameraTile { id, seen, cameras } in tiles {
        row.write(vec![
            id.x.into(),
            id.y.into(),
            tile_bytes(&seen.tile).into(),
            bytes(&seen.seconds).into(),
            bytes(cameras).into(),
        ])?;
    }
    Ok(())
}

fn record(row: &Row<'_>) -> Result<(RobotId, TileRecord), Trouble> {
    let record = TileRecord {
        id: TileId { x: row.get(1)?, y: row.get(2)? },
        stamp: Stamp { epoch: Epoch(row.get(3)?), version: Version(row.get(4)?) },
        cells: tile(row, 5)?,
        known: tile(row, 6)?,
        // If the row of the times was damaged, it is missing, and the cells get the oldest possible
        // time.
        seconds: match row.get_ref(7)? {
            ValueRef::Null => [0; TILE_CELLS as usize],
            _ => cells(row, 7)?,
        },
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
