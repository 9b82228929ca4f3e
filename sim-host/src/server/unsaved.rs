//! State that is not on disk yet.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use ubimap_protocol::{
    tile::{Epoch, TileId},
    units::RobotId,
};

use super::session::Session;
use crate::mapping::{CureRecord, RobotLayer, TileRecord, Updated};

/// Tiles and cures (corrections of robots' constant errors) waiting to be written.
#[derive(Debug)]
pub(super) struct Unsaved {
    /// Whether the server has a store.
    stores: bool,
    /// Epochs of tiles that have changed since they were last handed out.
    changed: BTreeSet<(RobotId, TileId, Epoch)>,
    /// The progress of cures that is not on disk yet, oldest first.
    cures: VecDeque<CureRecord>,
}

impl Unsaved {
    pub(super) fn new(stores: bool) -> Self {
        Self { stores, changed: BTreeSet::new(), cures: VecDeque::new() }
    }

    /// Queues the complete states of an update, and the epochs that it closed. States that are
    /// already on disk are reported to the robot.
    pub(super) fn came(&mut self, session: &mut Session, layer: &RobotLayer, updated: &Updated) {
        self.folded(session.robot(), &updated.folded);
        for &(id, epoch) in updated.complete.iter().filter(|_| self.stores) {
            match layer.on_disk(id, epoch) {
                Some(stamp) => session.stored(id, stamp),
                None => drop(self.changed.insert((session.robot(), id, epoch))),
            }
        }
    }

    /// Queues the given closed epochs of tiles.
    pub(super) fn folded(&mut self, robot: RobotId, folded: &BTreeSet<(TileId, Epoch)>) {
        let folded = folded.iter().filter(|_| self.stores);
        self.changed.extend(folded.map(|&(id, epoch)| (robot, id, epoch)));
    }

    /// The next record of a tile to write, from the robots' layers.
    pub(super) fn poll_tile(
        &mut self,
        layers: &BTreeMap<RobotId, RobotLayer>,
    ) -> Option<(RobotId, TileRecord)> {
        while let Some((robot, id, epoch)) = self.changed.pop_first() {
            // There is no record of a partly received state, which is queued again when it is
            // complete, or of an epoch that has become part of a newer closed one.
            if let Some(record) = layers.get(&robot).and_then(|it| it.record(id, epoch)) {
                return Some((robot, record));
            }
        }
        None
    }

    /// Queues a record again that could not be written.
    pub(super) fn tile_failed(&mut self, robot: RobotId, record: &TileRecord) {
        self.changed.insert((robot, record.id, record.stamp.epoch));
    }

    /// Queues the progress of a cure.
    pub(super) fn add_cure(&mut self, record: CureRecord) {
        self.cures.extend(self.stores.then_some(record));
    }

    /// Whether the robot's cure must wait until its progress is on disk.
    pub(super) fn holds_up(&self, robot: RobotId) -> bool {
        self.cures.iter().any(|record| record.robot == robot)
    }

    /// The progress of cures, oldest first.
    pub(super) fn cures(&self) -> impl Iterator<Item = &CureRecord> {
        self.cures.iter()
    }

    /// Removes the progress of a cure that is on disk.
    pub(super) fn cure_stored(&mut self, record: &CureRecord) {
        self.cures.retain(|it| it != record);
    }

    pub(super) fn is_empty(&self) -> bool {
        self.changed.is_empty() && self.cures.is_empty()
    }
}
