//! A model of the disk of a server that may be killed at any time: confirmed writes survive, and so
//! does an arbitrary part of the unconfirmed ones.

use std::{
    collections::{BTreeMap, VecDeque},
    path::Path,
};

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use ubimap_agent::map::{OwnTile, Pool};
use ubimap_protocol::{
    tile::{Epoch, TILE_CELLS, TILE_SIDE, Tile, TileId, Version},
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};
use ubimap_sim_host::{
    mapping::{CureRecord, TileRecord},
    server::Server,
    store::Store,
};

/// Maximum duration of a write in microseconds, as on a busy disk.
const SLOWEST: u64 = 1_500_000;

/// The share of writes that fail.
const FAILING: f64 = 0.1;

/// Number of records that a real store takes in one transaction.
const BATCH: usize = 64;

/// A robot's own tiles, with the version of each that it published last.
pub type Held = BTreeMap<(TileId, Epoch), Version>;

/// What is written.
#[derive(Clone, Debug, Default)]
struct Contents {
    tiles: BTreeMap<(RobotId, TileId, Epoch), TileRecord>,
    seconds: BTreeMap<(RobotId, TileId), [u32; TILE_CELLS as usize]>,
    cures: BTreeMap<RobotId, CureRecord>,
}

/// The disk.
#[derive(Debug, Default)]
pub struct Disk {
    contents: Contents,
    backup: Contents,
    /// Writes in progress, with the time at which each will be confirmed.
    writes: VecDeque<(Instant, RobotId, TileRecord)>,
    /// All writes before this time fail.
    fails_until: Instant,
    copy: Option<Copy>,
}

/// A real store that is given the same records as this model.
#[derive(Debug)]
struct Copy {
    store: Store,
    /// Records that have not been written to it yet.
    unwritten: Vec<(RobotId, TileRecord)>,
}

impl Disk {
    /// Starts the server's pending writes, and confirms those due by `now`, except a share that
    /// fails.
    pub fn work(&mut self, server: &mut Server, now: Instant, rng: &mut ChaCha8Rng) {
        while let Some((robot, record)) = server.poll_store() {
            let at = now + Duration(rng.random_range(0..SLOWEST));
            // Writes are confirmed in order.
            let at = self.writes.back().map_or(at, |&(before, ..)| at.max(before));
            self.writes.push_back((at, robot, record));
        }
        while let Some((_, robot, record)) = self.writes.pop_front_if(|(at, ..)| *at <= now) {
            if rng.random_bool(FAILING) || now < self.fails_until {
                server.store_failed(robot, &record);
                continue;
            }
            server.stored(robot, &record);
            self.write(robot, record);
        }
        let cures: Vec<CureRecord> = server.unsaved_cures().copied().collect();
        for record in cures {
            if rng.random_bool(FAILING) {
                break;
            }
            self.write_cure(record);
            server.cure_stored(&record);
        }
    }

    /// Writes the progress of a cure, and deletes the robot's void tiles.
    ///
    /// # Panics If the real store, if there is one, can't be written.
    pub fn write_cure(&mut self, record: CureRecord) {
        let is_void = |robot, epoch| robot == record.robot && epoch < record.first_epoch;
        self.contents.tiles.retain(|&(robot, _, epoch), _| !is_void(robot, epoch));
        self.writes.retain(|(_, robot, tile)| !is_void(*robot, tile.stamp.epoch));
        if let Some(copy) = &mut self.copy {
            copy.write();
            copy.store.cure(&record).expect("the store can be written");
        }
        self.contents.cures.insert(record.robot, record);
    }

    /// The robots with a cure (a correction of a constant error) in progress.
    pub fn curing(&self) -> impl Iterator<Item = RobotId> {
        let cures = self.contents.cures.values().filter(|record| !record.is_over);
        cures.map(|record| record.robot)
    }

    /// Copies what is written.
    pub fn back_up(&mut self) {
        self.backup = self.contents.clone();
    }

    /// Replaces the contents by those of the last copy; empties the disk if there is none.
    pub fn revert(&mut self) {
        self.contents = self.backup.clone();
        self.writes.clear();
    }

    /// Number of writes in progress.
    pub fn writes(&self) -> usize {
        self.writes.len()
    }

    /// Makes all writes before `until` fail.
    pub fn fail_until(&mut self, until: Instant) {
        self.fails_until = self.fails_until.max(until);
    }

    /// Also writes to this file from now on, and restores from it. The disk must be empty.
    ///
    /// # Panics If the file can't be created.
    pub fn copy_to(&mut self, path: &Path, resolution: Millimetres) {
        let store = Store::open(path, resolution).expect("the store is new");
        self.copy = Some(Copy { store, unwritten: Vec::new() });
    }

    /// Bytes of the real store's files, up to date.
    ///
    /// # Panics If there is no real store, or it can't be written.
    pub fn bytes(&mut self) -> u64 {
        let copy = self.copy.as_mut().expect("there is a store");
        copy.write();
        let log = copy.store.path().with_extension("db-wal");
        [copy.store.path(), &log]
            .map(|path| path.metadata().map_or(0, |file| file.len()))
            .iter()
            .sum()
    }

    /// When the next write will be confirmed.
    pub fn next_due(&self) -> Option<Instant> {
        self.writes.front().map(|&(at, ..)| at)
    }

    /// Kills the server; part of the writes in progress reach the disk nevertheless.
    pub fn survive(&mut self, rng: &mut ChaCha8Rng) {
        let written = rng.random_range(0..=self.writes.len());
        let writes: Vec<_> = self.writes.drain(..).take(written).collect();
        writes.into_iter().for_each(|(_, robot, record)| self.write(robot, record));
    }

    /// Restores the stored records into a new server.
    ///
    /// # Panics If the real store, if there is one, holds anything else.
    pub fn restore(&mut self, server: &mut Server) {
        for record in self.contents.cures.values() {
            server.restore_cured(record);
        }
        let stored = self.contents.tiles.iter().map(|(&(robot, id, _), record)| {
            let seconds = self.contents.seconds[&(robot, id)];
            (robot, TileRecord { seconds, ..record.clone() })
        });
        let mut records: Vec<_> = stored.collect();
        if let Some(copy) = &mut self.copy {
            copy.write();
            let copied = copy.store.records().expect("the store can be read");
            assert!(copied == records, "the store holds something else");
            records = copied;
        }
        records.iter().for_each(|(robot, record)| server.restore(*robot, record));
    }

    /// Checks that the server knows every stored cell.
    ///
    /// # Panics If a stored cell is lost.
    pub fn check_server(&self, server: &Server) {
        for (&(robot, id, _), record) in &self.contents.tiles {
            let seen = server.layer(robot).and_then(|layer| layer.seen(id));
            let known = |tile: &Tile, y: usize| tile.row(y).known();
            let kept = seen.is_some_and(|seen| {
                (0..TILE_SIDE).all(|y| known(&record.known, y) & !known(&seen.tile, y) == 0)
            });
            assert!(kept, "{id:?} of robot {} was stored but is lost", robot.0);
        }
    }

    /// Checks that every tile is stored that the robot believes to be stored, or has discarded
    /// since `before`. Nothing is checked if `is_excused`.
    ///
    /// # Panics If such a tile is not stored.
    pub fn check_robot(
        &self,
        robot: RobotId,
        pool: &Pool<'_>,
        before: &mut Held,
        is_excused: bool,
    ) {
        let mut held = Held::new();
        for tile in pool.tiles() {
            let Some(id) = tile.id() else { continue };
            held.insert((id, tile.epoch()), tile.publication().version());
            let stored = is_excused || tile.stored() == Version(0) || self.has(robot, id, tile);
            assert!(stored, "robot {} believes that {id:?} {:?} is stored", robot.0, tile.stored());
        }
        // A tile that has been moved to a later epoch keeps its version.
        let is_held = |&(id, epoch): &(TileId, Epoch), version: Version| {
            let mut later = held.range((id, epoch)..=(id, Epoch(u32::MAX)));
            later.any(|(_, held)| *held >= version)
        };
        let gone = before.iter().filter(|(key, it)| !is_excused && !is_held(key, **it));
        for (&(id, epoch), &version) in gone {
            let there = self.contents.tiles.get(&(robot, id, epoch));
            let stored = there.is_some_and(|record| record.stamp.version >= version);
            assert!(
                stored || version == Version(0),
                "robot {} discarded {id:?} {epoch:?} before it was stored",
                robot.0
            );
        }
        *before = held;
    }

    /// Whether the version that a robot believes to be stored is on disk. If it is the robot's
    /// newest version, the cells must be equal, too.
    fn has(&self, robot: RobotId, id: TileId, tile: &OwnTile) -> bool {
        let Some(record) = self.contents.tiles.get(&(robot, id, tile.epoch())) else {
            return false;
        };
        let sent = tile.publication();
        let same = sent.is_acknowledged() && sent.version() == record.stamp.version;
        record.stamp.version >= tile.stored() && (!same || record.cells == *sent.sent())
    }

    fn write(&mut self, robot: RobotId, record: TileRecord) {
        if let Some(copy) = &mut self.copy {
            copy.unwritten.push((robot, record.clone()));
            if copy.unwritten.len() >= BATCH {
                copy.write();
            }
        }
        let (id, epoch) = (record.id, record.stamp.epoch);
        self.contents.seconds.insert((robot, id), record.seconds);
        if record.is_closed() {
            let closed = (robot, id, Epoch(0))..=(robot, id, epoch);
            self.contents.tiles.extract_if(closed, |_, _| true).for_each(drop);
        }
        self.contents.tiles.insert((robot, id, epoch), record);
    }
}

impl Copy {
    fn write(&mut self) {
        self.store.keep(&self.unwritten, Instant(0)).expect("the store can be written");
        self.unwritten.clear();
    }
}
