//! A model of the disk of a server that may be killed at any time: confirmed writes survive, and an
//! arbitrary part of the others.

use std::collections::{BTreeMap, VecDeque};

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use ubimap_agent::map::{OwnTile, Pool};
use ubimap_protocol::{
    tile::{Epoch, TILE_CELLS, TILE_SIDE, Tile, TileId, Version},
    time::{Duration, Instant},
    units::RobotId,
};
use ubimap_sim_host::{mapping::TileRecord, server::Server};

/// Maximum duration of a write in microseconds, as on a busy disk.
const SLOWEST: u64 = 1_500_000;

/// The share of writes that fail.
const FAILING: f64 = 0.1;

/// A robot's own tiles, with the version of each that it published last.
pub type Held = BTreeMap<(TileId, Epoch), Version>;

/// The disk.
#[derive(Debug, Default)]
pub struct Disk {
    tiles: BTreeMap<(RobotId, TileId, Epoch), TileRecord>,
    seconds: BTreeMap<(RobotId, TileId), [u32; TILE_CELLS as usize]>,
    /// Writes in progress, with the time at which each will be confirmed.
    writes: VecDeque<(Instant, RobotId, TileRecord)>,
}

impl Disk {
    /// Starts the server's pending writes, and confirms those due by `now`, but for some that fail.
    pub fn work(&mut self, server: &mut Server, now: Instant, rng: &mut ChaCha8Rng) {
        while let Some((robot, record)) = server.poll_store() {
            let at = now + Duration(rng.random_range(0..SLOWEST));
            // Writes are confirmed in order.
            let at = self.writes.back().map_or(at, |&(before, ..)| at.max(before));
            self.writes.push_back((at, robot, record));
        }
        while let Some((_, robot, record)) = self.writes.pop_front_if(|(at, ..)| *at <= now) {
            if rng.random_bool(FAILING) {
                server.store_failed(robot, &record);
                continue;
            }
            server.stored(robot, &record);
            self.write(robot, record);
        }
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
    pub fn restore(&self, server: &mut Server) {
        for (&(robot, id, _), record) in &self.tiles {
            let seconds = self.seconds[&(robot, id)];
            server.restore(robot, &TileRecord { seconds, ..record.clone() });
        }
    }

    /// Checks that the server knows every stored cell.
    ///
    /// # Panics If a stored cell is lost.
    pub fn check_server(&self, server: &Server) {
        for (&(robot, id, _), record) in &self.tiles {
            let seen = server.layer(robot).and_then(|layer| layer.seen(id));
            let known = |tile: &Tile, y: usize| tile.row(y).known();
            let kept = seen.is_some_and(|seen| {
                (0..TILE_SIDE).all(|y| known(&record.known, y) & !known(&seen.tile, y) == 0)
            });
            assert!(kept, "{id:?} of robot {} was stored but is lost", robot.0);
        }
    }

    /// Checks that each tile is stored that a robot believes to be stored, or that it has discarded
    /// since `before`.
    ///
    /// # Panics If such a tile is not stored.
    pub fn check_robot(&self, robot: RobotId, pool: &Pool<'_>, before: &mut Held) {
        let mut held = Held::new();
        for tile in pool.tiles() {
            let Some(id) = tile.id() else { continue };
            held.insert((id, tile.epoch()), tile.publication().version());
            let stored = tile.stored() == Version(0) || self.has(robot, id, tile);
            assert!(stored, "robot {} believes that {id:?} {:?} is stored", robot.0, tile.stored());
        }
        for (&(id, epoch), &version) in before.iter().filter(|(key, _)| !held.contains_key(key)) {
            let there = self.tiles.get(&(robot, id, epoch));
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
        let Some(record) = self.tiles.get(&(robot, id, tile.epoch())) else { return false };
        let sent = tile.publication();
        let same = sent.is_acknowledged() && sent.version() == record.stamp.version;
        record.stamp.version >= tile.stored() && (!same || record.cells == *sent.sent())
    }

    fn write(&mut self, robot: RobotId, record: TileRecord) {
        let (id, epoch) = (record.id, record.stamp.epoch);
        self.seconds.insert((robot, id), record.seconds);
        if record.is_closed() {
            let closed = (robot, id, Epoch(0))..=(robot, id, epoch);
            self.tiles.extract_if(closed, |_, _| true).for_each(drop);
        }
        self.tiles.insert((robot, id, epoch), record);
    }
}
