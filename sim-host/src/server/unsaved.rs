//! What is not on disk yet.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use ubimap_protocol::{
    tile::{Epoch, TileId},
    units::RobotId,
};

use super::session::Session;
use crate::mapping::{CureRecord, RobotLayer, TileRecord};

/// Tiles and cures that wait to be written.
#[derive(Debug)]
pub(super) struct Unsaved {
    /// Whether there is a disk.
    stores: bool,
    /// Tiles that have changed since they were last handed out.
    changed: BTreeSet<(RobotId, TileId, Epoch)>,
    /// The progress of cures, until each is on disk; oldest first.
    cures: VecDeque<CureRecord>,
}

impl Unsaved {
    pub(super) fn new(stores: bool) -> Self {
        Self { stores, changed: BTreeSet::new(), cures: VecDeque::new() }
    }

    /// A state of these tiles and epochs has come completely. The robot is told which it need not
    /// keep.
    pub(super) fn came(
        &mut self,
        session: &mut Session,
        layer: &RobotLayer,
        complete: &BTreeSet<(TileId, Epoch)>,
    ) {
        for &(id, epoch) in complete.iter().filter(|_| self.stores) {
            match layer.on_disk(id, epoch) {
                Some(stamp) => session.stored(id, stamp),
                None => drop(self.changed.insert((session.robot(), id, epoch))),
            }
        }
    }

    /// The next tile to be written.
    pub(super) fn poll_tile(
        &mut self,
        layers: &BTreeMap<RobotId, RobotLayer>,
    ) -> Option<(RobotId, TileRecord)> {
        while let Some((robot, id, epoch)) = self.changed.pop_first() {
            // A state that has arrived in part comes back when it is complete.
            if let Some(record) = layers.get(&robot).and_then(|it| it.record(id, epoch)) {
                return Some((robot, record));
            }
        }
        None
    }

    /// A tile could not be written: it is handed out again.
    pub(super) fn tile_failed(&mut self, robot: RobotId, record: &TileRecord) {
        self.changed.insert((robot, record.id, record.stamp.epoch));
    }

    /// A cure has progressed.
    pub(super) fn add_cure(&mut self, record: CureRecord) {
        self.cures.extend(self.stores.then_some(record));
    }

    /// Whether the cure of a robot must wait, as its progress is not on disk.
    pub(super) fn holds_up(&self, robot: RobotId) -> bool {
        self.cures.iter().any(|record| record.robot == robot)
    }

    /// The progress of cures, oldest first.
    pub(super) fn cures(&self) -> impl Iterator<Item = &CureRecord> {
        self.cures.iter()
    }

    /// The progress of a cure is on disk.
    pub(super) fn cure_stored(&mut self, record: &CureRecord) {
        self.cures.retain(|it| it != record);
    }

    pub(super) fn is_empty(&self) -> bool {
        self.changed.is_empty() && self.cures.is_empty()
    }
}
