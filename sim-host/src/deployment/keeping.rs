//! When what must not be lost goes to the disk, and what goes together.

use ubimap_protocol::{
    time::{Duration, Instant},
    units::RobotId,
};

use crate::{
    mapping::{CameraTile, CureRecord, TileRecord},
    server::Server,
};

/// From one batch with robots' tiles to the next. A robot waits for it before it gives up a tile;
/// a commit costs some ten milliseconds, however much is in it.
const COMMIT_INTERVAL: Duration = Duration::from_millis(250);
/// From one batch with what cameras have seen to the next: they see most of it again.
const CAMERA_INTERVAL: Duration = Duration::from_secs(10);
/// How long to wait after a batch could not be written.
const RETRY_INTERVAL: Duration = Duration::from_secs(1);

/// What is to be written in one go: whoever writes it gives it back, by
/// [`Deployment::stored`](super::Deployment::stored) or
/// [`Deployment::store_failed`](super::Deployment::store_failed).
#[derive(Clone, Debug, PartialEq)]
pub struct Batch {
    /// When it was made, by the server's clock: the next life begins after it.
    pub clock: Instant,
    /// What cameras have seen.
    pub camera_tiles: Vec<CameraTile>,
    /// How far cures have come. Tiles of the robot below a record's first epoch are to be deleted
    /// before the tiles of the batch are written.
    pub cures: Vec<CureRecord>,
    /// States of robots' tiles.
    pub tiles: Vec<(RobotId, TileRecord)>,
}

impl Batch {
    fn is_empty(&self) -> bool {
        self.camera_tiles.is_empty() && self.cures.is_empty() && self.tiles.is_empty()
    }
}

/// What is due to be written, by the server's clock.
#[derive(Debug)]
pub(super) struct Keeping {
    next_commit: Instant,
    next_camera_tiles: Instant,
    /// A batch is being written; there is no other one before it has come back.
    is_writing: bool,
}

impl Keeping {
    /// For a life that begins then.
    pub(super) fn new(begins: Instant) -> Self {
        let next_camera_tiles = begins + CAMERA_INTERVAL;
        Self { next_commit: begins, next_camera_tiles, is_writing: false }
    }

    /// When there is a batch, at the latest.
    pub(super) fn poll_timeout(&self, server: &Server) -> Option<Instant> {
        let commit = server.has_unsaved().then_some(self.next_commit);
        let camera_tiles = server.has_camera_tiles().then_some(self.next_camera_tiles);
        commit.into_iter().chain(camera_tiles).min().filter(|_| !self.is_writing)
    }

    /// The batch that is due.
    pub(super) fn poll(&mut self, server: &mut Server, now: Instant) -> Option<Batch> {
        if self.poll_timeout(server).is_none_or(|due| now < due) {
            return None;
        }
        let mut batch =
            Batch { clock: now, camera_tiles: Vec::new(), cures: Vec::new(), tiles: Vec::new() };
        if self.next_camera_tiles <= now {
            self.next_camera_tiles = now + CAMERA_INTERVAL;
            batch.camera_tiles = server.take_camera_tiles();
        }
        if self.next_commit <= now {
            self.next_commit = now + COMMIT_INTERVAL;
            batch.cures = server.unsaved_cures().copied().collect();
            batch.tiles = std::iter::from_fn(|| server.poll_store()).collect();
        }
        self.is_writing = !batch.is_empty();
        self.is_writing.then_some(batch)
    }

    /// The batch is on disk.
    pub(super) fn stored(&mut self, server: &mut Server, batch: &Batch) {
        self.is_writing = false;
        batch.cures.iter().for_each(|record| server.cure_stored(record));
        batch.tiles.iter().for_each(|(robot, record)| server.stored(*robot, record));
    }

    /// Nothing of the batch, or not all of it, is on disk: it is handed out again after a while.
    pub(super) fn failed(&mut self, server: &mut Server, batch: &Batch, now: Instant) {
        self.is_writing = false;
        self.next_commit = now + RETRY_INTERVAL;
        if !batch.camera_tiles.is_empty() {
            self.next_camera_tiles = now + RETRY_INTERVAL;
            server.camera_tiles_failed(&batch.camera_tiles);
        }
        batch.tiles.iter().for_each(|(robot, record)| server.store_failed(*robot, record));
    }

    /// Whether something is not on disk that must not be lost.
    pub(super) fn has_unsaved(&self, server: &Server) -> bool {
        self.is_writing || server.has_unsaved()
    }
}
