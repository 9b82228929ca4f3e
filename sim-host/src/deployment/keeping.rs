//! Decides when state is written to disk, and in which batches.

use ubimap_protocol::{
    time::{Duration, Instant},
    units::RobotId,
};

use crate::{
    mapping::{CameraTile, CureRecord, Placement, TileRecord},
    server::Server,
};

/// Interval between batches of robots' tiles. A robot keeps a tile until it is stored; a commit of
/// any size costs some 10 ms.
const COMMIT_INTERVAL: Duration = Duration::from_millis(250);
/// Maximum number of robots' tiles in a batch: 1.3 MB, so that writing a batch does not delay fixes
/// for long.
const MAX_TILES: usize = 256;
/// Interval between batches of camera tiles and of placements. Longer than [`COMMIT_INTERVAL`], because cameras see
/// most of these cells again after a restart.
const CAMERA_INTERVAL: Duration = Duration::from_secs(10);
/// Delay before a failed batch is written again.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// Records to be written in one transaction. Return the batch with
/// [`Deployment::stored`](super::Deployment::stored) or
/// [`Deployment::store_failed`](super::Deployment::store_failed).
#[derive(Clone, Debug, PartialEq)]
pub struct Batch {
    /// When the batch was made, by the server's clock; the clock of the next life starts later.
    pub clock: Instant,
    /// Tiles that cameras have seen.
    pub camera_tiles: Vec<CameraTile>,
    /// What is known of where robots were: what has changed of it.
    pub placements: Vec<(RobotId, Placement)>,
    /// Progress of cures (corrections of robots' constant errors). Before writing the tiles of this
    /// batch, delete the tiles of each record's robot in epochs below its `first_epoch`.
    pub cures: Vec<CureRecord>,
    /// States of robots' tiles.
    pub tiles: Vec<(RobotId, TileRecord)>,
}

impl Batch {
    fn is_empty(&self) -> bool {
        self.camera_tiles.is_empty()
            && self.placements.is_empty()
            && self.cures.is_empty()
            && self.tiles.is_empty()
    }
}

/// When the next batches are due, by the server's clock.
#[derive(Debug)]
pub(super) struct Keeping {
    next_commit: Instant,
    next_camera_tiles: Instant,
    /// Whether a batch is being written. No other one is handed out until it is returned.
    is_writing: bool,
}

impl Keeping {
    /// Starts at the time `begins`, when a life begins.
    pub(super) fn new(begins: Instant) -> Self {
        let next_camera_tiles = begins + CAMERA_INTERVAL;
        Self { next_commit: begins, next_camera_tiles, is_writing: false }
    }

    /// When the next batch is due; `None` if there is nothing to write or a batch is being written.
    pub(super) fn poll_timeout(&self, server: &Server) -> Option<Instant> {
        let commit = server.has_unsaved().then_some(self.next_commit);
        let camera_tiles = (server.has_camera_tiles() || server.has_placements())
            .then_some(self.next_camera_tiles);
        commit.into_iter().chain(camera_tiles).min().filter(|_| !self.is_writing)
    }

    /// Returns the next batch, if it is due.
    pub(super) fn poll(&mut self, server: &mut Server, now: Instant) -> Option<Batch> {
        if self.poll_timeout(server).is_none_or(|due| now < due) {
            return None;
        }
        let mut batch = Batch {
            clock: now,
            camera_tiles: Vec::new(),
            placements: Vec::new(),
            cures: Vec::new(),
            tiles: Vec::new(),
        };
        if self.next_camera_tiles <= now {
            self.next_camera_tiles = now + CAMERA_INTERVAL;
            batch.camera_tiles = server.take_camera_tiles();
            batch.placements = server.take_placements();
        }
        if self.next_commit <= now {
            self.next_commit = now + COMMIT_INTERVAL;
            batch.cures = server.unsaved_cures().copied().collect();
            batch.tiles = std::iter::from_fn(|| server.poll_store()).take(MAX_TILES).collect();
        }
        self.is_writing = !batch.is_empty();
        self.is_writing.then_some(batch)
    }

    /// Makes the next batches of both kinds due at `now`.
    pub(super) fn hasten(&mut self, now: Instant) {
        self.next_commit = now;
        self.next_camera_tiles = now;
    }

    /// Tells the server that a batch is on disk.
    pub(super) fn stored(&mut self, server: &mut Server, batch: &Batch) {
        self.is_writing = false;
        batch.cures.iter().for_each(|record| server.cure_stored(record));
        batch.tiles.iter().for_each(|(robot, record)| server.stored(*robot, record));
    }

    /// Schedules a batch that is not completely on disk for another attempt.
    pub(super) fn failed(&mut self, server: &mut Server, batch: &Batch, now: Instant) {
        self.is_writing = false;
        self.next_commit = now + RETRY_INTERVAL;
        if !batch.camera_tiles.is_empty() || !batch.placements.is_empty() {
            self.next_camera_tiles = now + RETRY_INTERVAL;
            server.camera_tiles_failed(&batch.camera_tiles);
            server.placements_failed(&batch.placements);
        }
        batch.tiles.iter().for_each(|(robot, record)| server.store_failed(*robot, record));
    }

    /// Whether state that must not be lost is not on disk yet.
    pub(super) fn has_unsaved(&self, server: &Server) -> bool {
        self.is_writing || server.has_unsaved()
    }
}
