//! State that the server hands out for storage, and restores after a restart.

use ubimap_protocol::{
    tile::{Epoch, TileId},
    units::RobotId,
};

use super::Server;
use crate::mapping::{CameraTile, CureRecord, Placement, TileRecord};

impl Server {
    /// The next state of a robot's tile to write, if the server has a store (`stores` in its
    /// terms). A [closed](TileRecord::is_closed) record replaces those of all epochs up to its own;
    /// delete them in the same transaction. Call [`Server::stored`] when it is on disk, or
    /// [`Server::store_failed`].
    #[must_use]
    pub fn poll_store(&mut self) -> Option<(RobotId, TileRecord)> {
        self.unsaved.poll_tile(self.map.layers())
    }

    /// Call this once a tile is durably on disk: the robot may then discard it.
    pub fn stored(&mut self, robot: RobotId, record: &TileRecord) {
        self.map.stored(robot, record);
        // Robots do not wait for closed epochs to be stored.
        if let Some(session) = self.ports.session_mut(robot).filter(|_| !record.is_closed()) {
            session.stored(record.id, record.stamp);
        }
    }

    /// Call this if a tile could not be written. [`Server::poll_store`] hands it out again.
    pub fn store_failed(&mut self, robot: RobotId, record: &TileRecord) {
        self.unsaved.tile_failed(robot, record);
    }

    /// The progress of cures (corrections of robots' constant errors) that is not on disk yet,
    /// oldest first. A cure waits until its progress is stored. When storing a record, delete the
    /// robot's tiles of epochs below its `first_epoch`.
    pub fn unsaved_cures(&self) -> impl Iterator<Item = &CureRecord> {
        self.unsaved.cures()
    }

    /// Call this once the progress of a cure is on disk.
    pub fn cure_stored(&mut self, record: &CureRecord) {
        self.unsaved.cure_stored(record);
    }

    /// Whether a robot's tile or cure waits to be written.
    pub fn has_unsaved(&self) -> bool {
        !self.unsaved.is_empty()
    }

    /// Takes the camera tiles that were observed since the last call, to be written. Not urgent:
    /// every few seconds is enough.
    #[must_use]
    pub fn take_camera_tiles(&mut self) -> Vec<CameraTile> {
        self.map.take_unkept()
    }

    /// Call this if camera tiles could not be written. [`Server::take_camera_tiles`] hands them out
    /// again.
    pub fn camera_tiles_failed(&mut self, tiles: &[CameraTile]) {
        self.map.not_kept(tiles);
    }

    /// Whether [`Server::take_camera_tiles`] would return anything.
    pub fn has_camera_tiles(&self) -> bool {
        self.terms.stores && self.map.has_unkept()
    }

    /// Takes the robots' placements that have changed since the last call, to be written. Not urgent: every few seconds
    /// is enough.
    #[must_use]
    pub fn take_placements(&mut self) -> Vec<(RobotId, Placement)> {
        self.map.take_unkept_placements()
    }

    /// Call this if these could not be written. [`Server::take_placements`] hands them out again.
    pub fn placements_failed(&mut self, placements: &[(RobotId, Placement)]) {
        self.map.not_kept_placements(placements.iter().map(|(robot, _)| *robot));
    }

    /// Whether [`Server::take_placements`] would return anything.
    pub fn has_placements(&self) -> bool {
        self.terms.stores && self.map.has_unkept_placements()
    }

    /// Restores a robot's placement of an earlier run, after its tiles.
    pub fn restore_placement(&mut self, robot: RobotId, placement: &Placement) {
        self.corrections.restore_placement(robot, placement);
        self.map.place(robot, placement.clone(), self.terms.resolution);
    }

    /// Restores a record of an earlier run of the server. The records of a tile must come in the
    /// order of their epochs. The server's clock must continue from the earlier run, since the
    /// record's times refer to that.
    pub fn restore(&mut self, robot: RobotId, record: &TileRecord) {
        let folded = self.map.restore(robot, record);
        self.unsaved.folded(robot, &folded);
    }

    /// Makes the server request a tile that was damaged in the store, as soon as its robot has a
    /// session.
    pub fn restore_damaged(&mut self, robot: RobotId, id: TileId, epoch: Epoch) {
        self.damaged.add(robot, id, epoch);
    }

    /// Restores a camera tile of an earlier run; its times are treated as in [`Server::restore`].
    pub fn restore_camera_tile(&mut self, tile: &CameraTile) {
        self.map.restore_camera_tile(tile);
    }

    /// Restores the progress of a robot's cure, which then continues.
    pub fn restore_cured(&mut self, record: &CureRecord) {
        self.corrections.restore(record);
        let retired = self.map.retire(record.robot, record.first_epoch);
        self.unsaved.folded(record.robot, &retired.folded);
    }
}
