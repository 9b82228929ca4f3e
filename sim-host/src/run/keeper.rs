//! What joins the server with its store: what it was, what it must not lose, and when.

use std::path::Path;

use ubimap_protocol::{
    frame::MAX_FRAME,
    link::Terms,
    tile::Epoch,
    time::{Duration, Instant},
    units::{Millimetres, RobotId},
};

use super::options::RunOptions;
use crate::{
    mapping::TileRecord,
    server::Server,
    store::{Store, StoreError},
};

/// What has come in so long goes to the disk together, however much it is.
const COMMIT_INTERVAL: Duration = Duration::from_millis(250);

/// A life of the server that is kept in a file.
#[derive(Debug)]
pub struct Keeper {
    store: Store,
    epoch: Epoch,
    next_commit: Instant,
}

impl Keeper {
    /// Opens the file and begins a new life, with an epoch of at least `least`.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn open(path: &Path, resolution: Millimetres, least: Epoch) -> Result<Self, StoreError> {
        let mut store = Store::open(path, resolution)?;
        let epoch = store.begin_life(least)?;
        log::info!("{}: life {} of the server", path.display(), epoch.0);
        Ok(Self { next_commit: store.clock(), store, epoch })
    }

    /// When this life begins by the server's clock: a second after all that the file knows.
    pub fn begins(&self) -> Instant {
        match self.store.clock() {
            Instant(0) => Instant(0),
            last => last + Duration::from_secs(1),
        }
    }

    /// When to come back at the latest to call [`Keeper::keep`].
    pub fn poll_timeout(&self, server: &Server) -> Option<Instant> {
        server.has_unsaved().then_some(self.next_commit)
    }

    /// Writes what is due, and tells the server once it is on disk.
    ///
    /// # Errors
    /// [`StoreError`]; then nothing of it was written, and no robot is told that it was.
    pub fn keep(&mut self, server: &mut Server, now: Instant) -> Result<(), StoreError> {
        if self.poll_timeout(server).is_none_or(|due| now < due) {
            return Ok(());
        }
        self.next_commit = now + COMMIT_INTERVAL;
        while let Some((robot, epoch)) = server.poll_retired() {
            self.store.retire(robot, epoch)?;
        }
        let records: Vec<(RobotId, TileRecord)> =
            std::iter::from_fn(|| server.poll_store()).collect();
        if !records.is_empty() {
            self.store.keep(&records, now)?;
        }
        records.iter().for_each(|(robot, record)| server.stored(*robot, record));
        Ok(())
    }
}

impl RunOptions {
    /// The keeper of a run whose robots come with it, if a file is asked for.
    ///
    /// # Errors
    /// [`StoreError`].
    pub(super) fn keeper(&self, resolution: Millimetres) -> Result<Option<Keeper>, StoreError> {
        let path = self.store.as_deref();
        path.map(|path| Keeper::open(path, resolution, Epoch(1))).transpose()
    }
}

/// A server with so many ports: one that goes on from its file, or, without any, one of this epoch
/// that keeps nothing.
///
/// # Errors
/// [`StoreError`].
pub(super) fn server(
    keeper: Option<&Keeper>,
    resolution: Millimetres,
    epoch: Epoch,
    ports: usize,
) -> Result<Server, StoreError> {
    let terms = Terms {
        resolution,
        frame: MAX_FRAME as u16,
        server_epoch: keeper.map_or(epoch, |keeper| keeper.epoch).0,
        stores: keeper.is_some(),
    };
    let mut server = Server::new(terms, ports);
    if let Some(keeper) = keeper {
        let records = keeper.store.records()?;
        records.iter().for_each(|(robot, record)| server.restore(*robot, record));
        log::info!("{} states of tiles are restored", records.len());
    }
    Ok(server)
}
