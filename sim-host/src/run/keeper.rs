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
    mapping::{CureRecord, TileRecord},
    server::Server,
    store::{Store, StoreError},
};

/// What has come in so long goes to the disk together, however much it is.
const COMMIT_INTERVAL: Duration = Duration::from_millis(250);

/// What cameras have seen goes there so often: they see most of it again.
const CAMERA_INTERVAL: Duration = Duration::from_secs(10);

/// A life of the server that is kept in a file.
#[derive(Debug)]
pub struct Keeper {
    store: Store,
    epoch: Epoch,
    next_commit: Instant,
    next_camera_tiles: Instant,
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
        let next_commit = store.clock();
        Ok(Self { next_commit, next_camera_tiles: next_commit + CAMERA_INTERVAL, store, epoch })
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
        let commit = server.has_unsaved().then_some(self.next_commit);
        commit.into_iter().chain(server.has_camera_tiles().then_some(self.next_camera_tiles)).min()
    }

    /// Writes what is due, and tells the server once it is on disk.
    ///
    /// # Errors
    /// [`StoreError`]; then nothing of it was written, and no robot is told that it was.
    pub fn keep(&mut self, server: &mut Server, now: Instant) -> Result<(), StoreError> {
        if self.poll_timeout(server).is_none_or(|due| now < due) {
            return Ok(());
        }
        if self.next_camera_tiles <= now {
            self.next_camera_tiles = now + CAMERA_INTERVAL;
            self.store.keep_camera_tiles(&server.take_camera_tiles(), now)?;
        }
        if now < self.next_commit {
            return Ok(());
        }
        self.next_commit = now + COMMIT_INTERVAL;
        let cures: Vec<CureRecord> = server.unsaved_cures().copied().collect();
        for record in &cures {
            self.store.cure(record)?;
            server.cure_stored(record);
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
        let tiles = keeper.store.camera_tiles()?;
        tiles.iter().for_each(|tile| server.restore_camera_tile(tile));
        keeper.store.cured()?.iter().for_each(|record| server.restore_cured(record));
        log::info!(
            "{} states of robots' tiles and {} tiles of the cameras' are restored",
            records.len(),
            tiles.len()
        );
    }
    Ok(server)
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::{tile::Cell, units::Pose};

    use super::*;
    use crate::{
        camera::{Observation, Sighting},
        mapping::Cured,
        testing::Folder,
    };

    const RESOLUTION: Millimetres = Millimetres(50);

    #[test]
    fn what_cameras_saw_and_cured_is_there_in_the_next_life() {
        let folder = Folder::new("keeper");
        let path = folder.path().join("map.db");
        let mut keeper = Keeper::open(&path, RESOLUTION, Epoch(1)).unwrap();
        let mut first = server(Some(&keeper), RESOLUTION, Epoch(1), 0).unwrap();
        let observation = |captured, code: fn(i32) -> Cell| Observation {
            captured,
            cells: (-40..40).map(|x| ((x, x / 3), code(x))).collect(),
            ..Observation::default()
        };
        let floor = |x: i32| if x % 7 == 0 { Cell::Occupied } else { Cell::Free };
        first.observe(&observation(Instant(1_000_000), floor));
        assert_eq!(keeper.poll_timeout(&first), Some(Instant(10_000_000)));
        keeper.keep(&mut first, Instant(10_000_000)).unwrap();
        assert_eq!(keeper.poll_timeout(&first), None);
        let (robot, askew) = (RobotId(3), Cured { taken_out: 3.0, added: -2.0 });
        let record = CureRecord { robot, cured: askew, first_epoch: Epoch(9), is_over: true };
        keeper.store.cure(&record).unwrap();
        drop(keeper);

        let keeper = Keeper::open(&path, RESOLUTION, Epoch(1)).unwrap();
        let mut second = server(Some(&keeper), RESOLUTION, Epoch(1), 0).unwrap();
        assert!(first.fused().tiles().count() > 2);
        assert_eq!(second.fused().digest(), first.fused().digest());
        assert_eq!(second.errors(robot).map(|errors| errors.cured()), Some(askew));
        let seen = Pose::from_metres(0.5, 0.5, 1.0);
        let moment = keeper.begins();
        let robots = vec![Sighting::usual(robot, seen)];
        second.observe(&Observation { captured: moment, robots, ..Observation::default() });
        let (_, stands) = second.whereabouts(moment).next().unwrap();
        assert!(((seen.heading - stands.heading).degrees() - 3.0).abs() < 0.01);
        // The cameras of this life see what has changed meanwhile.
        first.observe(&observation(moment, |_| Cell::Free));
        second.observe(&observation(moment, |_| Cell::Free));
        assert_eq!(second.fused().digest(), first.fused().digest());
    }
}
