//! Stores a deployment's records in a file.

use std::path::Path;

use ubimap_protocol::{tile::Epoch, time::Instant, units::Millimetres};

use super::options::RunOptions;
use crate::{
    deployment::{Batch, Deployment, Kept, Life},
    store::{Damage, Store, StoreError},
};

/// Maximum number of lines about damaged rows.
const MAX_LINES: usize = 20;

/// Writes the records of a deployment to a file.
#[derive(Debug)]
pub struct Keeper {
    store: Store,
    /// Why the last attempt to write failed, as it was logged.
    trouble: Option<String>,
}

impl Keeper {
    /// Opens the file and begins a new life of the deployment, with the epoch `drawn`, or the next
    /// one if the file's last life had that. Call it before any robot is welcomed.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn open(
        path: &Path,
        resolution: Millimetres,
        drawn: Epoch,
    ) -> Result<(Self, Life), StoreError> {
        let mut store = Store::open(path, resolution)?;
        let epoch = store.begin_life(drawn)?;
        log::info!("{}: server epoch {}", path.display(), epoch.0);
        warn_of_damage(path, store.damage());
        let damaged_tiles = store.damage().iter().filter_map(|damage| match *damage {
            Damage::Tile(robot, id, epoch) => Some((robot, id, epoch)),
            _ => None,
        });
        let kept = Kept {
            clock: store.clock(),
            tiles: store.records()?,
            damaged_tiles: damaged_tiles.collect(),
            camera_tiles: store.camera_tiles()?,
            cures: store.cured()?,
            placements: store.placements()?,
        };
        log::info!(
            "restored {} robot tiles and {} camera tiles",
            kept.tiles.len(),
            kept.camera_tiles.len()
        );
        Ok((Self { store, trouble: None }, Life { kept: Some(kept), ..Life::new(epoch) }))
    }

    /// Writes the records that are due.
    ///
    /// # Errors
    /// [`StoreError`]. Then no robot gets an acknowledgement of the batch, and the deployment
    /// returns it again later.
    pub fn keep(&mut self, deployment: &mut Deployment, now: Instant) -> Result<(), StoreError> {
        while let Some(batch) = deployment.poll_store(now) {
            if let Err(error) = self.write(&batch) {
                deployment.store_failed(batch, now);
                return Err(error);
            }
            deployment.stored(batch);
        }
        Ok(())
    }

    /// Writes the records that are due. If that fails, the deployment returns them again later.
    /// Failures are logged once, and so is the recovery.
    pub fn keep_trying(&mut self, deployment: &mut Deployment, now: Instant) {
        while let Some(batch) = deployment.poll_store(now) {
            match self.write(&batch) {
                Ok(()) => {
                    deployment.stored(batch);
                    if self.trouble.take().is_some() {
                        log::warn!("{}: the map is stored again", self.store.path().display());
                    }
                }
                Err(error) => {
                    deployment.store_failed(batch, now);
                    let trouble = error.to_string();
                    if self.trouble.as_ref() != Some(&trouble) {
                        log::error!(
                            "{trouble}; until it is stored, robots keep what they have drawn"
                        );
                    }
                    self.trouble = Some(trouble);
                    return;
                }
            }
        }
    }

    fn write(&mut self, batch: &Batch) -> Result<(), StoreError> {
        if !batch.camera_tiles.is_empty() {
            self.store.keep_camera_tiles(&batch.camera_tiles, batch.clock)?;
        }
        for cure in &batch.cures {
            self.store.cure(cure)?;
        }
        if !batch.placements.is_empty() {
            self.store.keep_placements(&batch.placements, batch.clock)?;
        }
        if !batch.tiles.is_empty() {
            self.store.keep(&batch.tiles, batch.clock)?;
        }
        Ok(())
    }
}

/// Logs what was damaged.
fn warn_of_damage(path: &Path, damage: &[Damage]) {
    for damage in damage.iter().take(MAX_LINES) {
        log::warn!("{}: {damage}", path.display());
    }
    if damage.len() > MAX_LINES {
        let more = damage.len() - MAX_LINES;
        log::warn!("{}: {more} more rows are damaged and left out", path.display());
    }
    if !damage.is_empty() {
        log::warn!("{}: the disk may be failing; check it, and make backups", path.display());
    }
}

impl RunOptions {
    /// The keeper of a run, if a file is given, and the life that begins. For runs that start their
    /// own robots.
    ///
    /// # Errors
    /// [`StoreError`].
    pub(super) fn keeper(
        &self,
        resolution: Millimetres,
    ) -> Result<(Option<Keeper>, Life), StoreError> {
        open(self.store.as_deref(), resolution, Epoch(1))
    }
}

/// The keeper for a file, if one is given, and the life that begins, with the epoch `drawn` or the
/// next one.
///
/// # Errors
/// [`StoreError`].
pub(super) fn open(
    path: Option<&Path>,
    resolution: Millimetres,
    drawn: Epoch,
) -> Result<(Option<Keeper>, Life), StoreError> {
    let Some(path) = path else { return Ok((None, Life::new(drawn))) };
    let (keeper, life) = Keeper::open(path, resolution, drawn)?;
    Ok((Some(keeper), life))
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::{
        tile::Cell,
        time::Duration,
        units::{Pose, RobotId},
    };

    use super::*;
    use crate::{
        camera::{Observation, Sighting},
        deployment::Config,
        mapping::{CureRecord, Cured},
        testing::Folder,
    };

    const RESOLUTION: Millimetres = Millimetres(50);

    fn life(path: &Path) -> (Keeper, Deployment) {
        let (keeper, life) = Keeper::open(path, RESOLUTION, Epoch(1)).unwrap();
        (keeper, Deployment::new(Config::new(RESOLUTION), life).unwrap())
    }

    #[test]
    fn camera_tiles_and_corrected_errors_survive_a_restart() {
        let folder = Folder::new("keeper");
        let path = folder.path().join("map.db");
        let (mut keeper, mut first) = life(&path);
        let observation = |captured, code: fn(i32) -> Cell| Observation {
            captured,
            cells: (-40..40).map(|x| ((x, x / 3), code(x))).collect(),
            ..Observation::default()
        };
        let floor = |x: i32| if x % 7 == 0 { Cell::Occupied } else { Cell::Free };
        first.observe(observation(Instant(1_000_000), floor));
        let due = Instant(10_000_000);
        keeper.keep(&mut first, Instant(due.0 - 1)).unwrap();
        assert!(keeper.store.camera_tiles().unwrap().is_empty(), "it is not due");
        keeper.keep(&mut first, due).unwrap();
        let (robot, askew) = (RobotId(3), Cured { taken_out: 3.0, added: -2.0 });
        let record = CureRecord { robot, cured: askew, first_epoch: Epoch(9), is_over: true };
        keeper.store.cure(&record).unwrap();
        drop(keeper);

        let (_keeper, mut second) = life(&path);
        assert!(first.server().fused().tiles().count() > 2);
        assert_eq!(second.server().fused().digest(), first.server().fused().digest());
        assert_eq!(second.server().errors(robot).map(|errors| errors.cured()), Some(askew));
        // The clock continues one second after the last write of the first life.
        let began = Instant(0);
        assert_eq!(second.server_time(began), Instant(11_000_000));
        let seen = Pose::from_metres(0.5, 0.5, 1.0);
        let robots = vec![Sighting::usual(robot, seen)];
        second.observe(Observation { captured: began, robots, ..Observation::default() });
        let (_, stands) = second.server().whereabouts(second.server_time(began)).next().unwrap();
        assert!(((seen.heading - stands.heading).degrees() - 3.0).abs() < 0.01);
        // Cameras of the new life replace cells that have changed in between.
        first.observe(observation(Instant(11_000_000), |_| Cell::Free));
        second.observe(observation(began, |_| Cell::Free));
        assert_eq!(second.server().fused().digest(), first.server().fused().digest());
    }

    /// A full disk: nothing is acknowledged as stored, the deployment goes on, and everything is
    /// stored once there is space.
    #[test]
    fn a_full_disk_delays_storing() {
        let folder = Folder::new("keeper-full");
        let path = folder.path().join("map.db");
        let (mut keeper, mut deployment) = life(&path);
        let floor = |captured, tile: i32| Observation {
            captured,
            cells: (0..32).map(|x| ((32 * tile + x, x), Cell::Free)).collect(),
            ..Observation::default()
        };
        keeper.store.limit_pages(1);
        let mut now = Instant(10_000_000);
        for tile in 0..20 {
            deployment.observe(floor(now, tile));
            keeper.keep_trying(&mut deployment, now);
            assert!(keeper.trouble.as_ref().is_some_and(|it| it.contains("disk is full")));
            now = now + Duration::from_secs(10);
        }
        assert!(keeper.store.camera_tiles().unwrap().is_empty());
        assert_eq!(deployment.server().fused().tiles().count(), 20);

        keeper.store.limit_pages(u32::MAX);
        keeper.keep_trying(&mut deployment, now);
        assert_eq!(keeper.trouble, None);
        assert_eq!(keeper.store.camera_tiles().unwrap().len(), 20);
    }
}
