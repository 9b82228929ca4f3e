//! What the disk has not been told.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use ubimap_protocol::{
    tile::{Epoch, TileId},
    units::RobotId,
};

use super::session::Session;
use crate::mapping::{CureRecord, RobotLayer, TileRecord};

/// Of all robots.
#[derive(Debug)]
pub(super) struct Unsaved {
    /// Whether there is a disk.
    stores: bool,
    /// Tiles that have changed since they were kept.
    changed: BTreeSet<(RobotId, TileId, Epoch)>,
    /// How far cures have come.
    cured: VecDeque<CureRecord>,
}

impl Unsaved {
    pub(super) fn new(stores: bool) -> Self {
        Self { stores, changed: BTreeSet::new(), cured: VecDeque::new() }
    }

    /// Of these tiles and epochs all of a state has come. The robot is told which it need not keep.
    pub(super) fn came(
        &mut self,
        session: &mut Session,
        layer: &RobotLayer,
        complete: &BTreeSet<(TileId, Epoch)>,
    ) {
        for &(id, epoch) in complete.iter().filter(|_| self.stores) {
            match layer.on_disk(id, epoch) {
                Some(stamp) => session.stored(id, stamp),
                None => drop(self.changed.insert((session.robot, id, epoch))),
            }
        }
    }

    /// A cure has come on.
    pub(super) fn cured(&mut self, record: CureRecord) {
        self.cured.extend(self.stores.then_some(record));
    }

    /// Whether the cure of a robot must wait: how far it has come is not on disk.
    pub(super) fn holds_up(&self, robot: RobotId) -> bool {
        self.cured.iter().any(|record| record.robot == robot)
    }

    /// A state to be kept.
    pub(super) fn poll_store(
        &mut self,
        layers: &BTreeMap<RobotId, RobotLayer>,
    ) -> Option<(RobotId, TileRecord)> {
        while let Some((robot, id, epoch)) = self.changed.pop_first() {
            // A state of which only parts have arrived comes back when it is complete.
            if let Some(record) = layers.get(&robot).and_then(|it| it.record(id, epoch)) {
                return Some((robot, record));
            }
        }
        None
    }

    /// How far a cure has come; the oldest first.
    pub(super) fn poll_cured(&mut self) -> Option<CureRecord> {
        self.cured.pop_front()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.changed.is_empty() && self.cured.is_empty()
    }
}
