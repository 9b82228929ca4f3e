//! Robots' tiles that were damaged in the store. The robots are asked to send them again.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{
    tile::{Epoch, TileId},
    time::{Duration, Instant},
    units::RobotId,
};

use super::session::Session;

/// Time for a robot to send its tiles again after its session has begun. At 1 kB/s, 64 tiles take
/// some 15 s.
const RESEND_TIME: Duration = Duration::from_secs(60);

/// The damaged tiles that have not been received again.
#[derive(Debug, Default)]
pub(super) struct Damaged {
    robots: BTreeMap<RobotId, Awaited>,
}

#[derive(Debug, Default)]
struct Awaited {
    tiles: BTreeSet<(TileId, Epoch)>,
    /// Deadline for the tiles; `None` until the robot's first session.
    until: Option<Instant>,
}

impl Damaged {
    /// Adds a tile that was damaged in one epoch.
    pub(super) fn add(&mut self, robot: RobotId, id: TileId, epoch: Epoch) {
        self.robots.entry(robot).or_default().tiles.insert((id, epoch));
    }

    /// Requests the robot's tiles in a session that has just begun.
    pub(super) fn joined(&mut self, session: &mut Session, now: Instant) {
        if let Some(awaited) = self.robots.get_mut(&session.robot()) {
            awaited.until = Some(now + RESEND_TIME);
            for &(id, _) in &awaited.tiles {
                session.ask_for(id);
            }
        }
    }

    /// Removes tiles and epochs with complete states that have arrived from the robot.
    pub(super) fn came(&mut self, robot: RobotId, complete: &BTreeSet<(TileId, Epoch)>) {
        if let Some(awaited) = self.robots.get_mut(&robot) {
            awaited.tiles.retain(|tile| !complete.contains(tile));
            if awaited.tiles.is_empty() {
                self.robots.remove(&robot);
            }
        }
    }

    /// Returns the next robot that has missed its deadline, and the number of its tiles that are
    /// lost. Each robot is returned once. If a robot is not reachable, its deadline is extended.
    pub(super) fn poll_lost(
        &mut self,
        is_reachable: impl Fn(RobotId) -> bool,
        now: Instant,
    ) -> Option<(RobotId, usize)> {
        let mut is_due = |robot: &RobotId, awaited: &mut Awaited| {
            let is_late = awaited.until.is_some_and(|until| until <= now);
            if is_late && !is_reachable(*robot) {
                awaited.until = Some(now + RESEND_TIME);
            }
            is_late && is_reachable(*robot)
        };
        let (robot, lost) = self.robots.extract_if(.., &mut is_due).next()?;
        Some((robot, lost.tiles.len()))
    }

    /// The deadline for the next call of [`Damaged::poll_lost`].
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.robots.values().filter_map(|awaited| awaited.until).min()
    }
}
