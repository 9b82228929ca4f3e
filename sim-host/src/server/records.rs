//! What the server hands out to be kept on disk, and takes back in its next life.

use ubimap_protocol::units::RobotId;

use super::Server;
use crate::mapping::{CameraTile, CureRecord, TileRecord};

impl Server {
    /// A state of a robot's tile to be written, if the terms say that the server stores any. Call
    /// [`Server::stored`] when it is on disk, or [`Server::store_failed`].
    #[must_use]
    pub fn poll_store(&mut self) -> Option<(RobotId, TileRecord)> {
        self.unsaved.poll_tile(self.map.layers())
    }

    /// A tile is on disk, for good: the robot may give it up.
    pub fn stored(&mut self, robot: RobotId, record: &TileRecord) {
        self.map.stored(robot, record);
        if let Some(session) = self.ports.session_mut(robot) {
            session.stored(record.id, record.stamp);
        }
    }

    /// A tile could not be written. [`Server::poll_store`] hands it out again.
    pub fn store_failed(&mut self, robot: RobotId, record: &TileRecord) {
        self.unsaved.tile_failed(robot, record);
    }

    /// The progress of the robots' cures that is not on disk, oldest first. A cure does not go on
    /// before. Tiles of the robot below the record's first epoch are to be deleted there.
    pub fn unsaved_cures(&self) -> impl Iterator<Item = &CureRecord> {
        self.unsaved.cures()
    }

    /// The progress of a cure is on disk.
    pub fn cure_stored(&mut self, record: &CureRecord) {
        self.unsaved.cure_stored(record);
    }

    /// Whether a robot's tile or cure waits to be written.
    pub fn has_unsaved(&self) -> bool {
        !self.unsaved.is_empty()
    }

    /// The tiles of which cameras have seen something since this was last called, to be written.
    /// Nobody waits for that: every few seconds is enough.
    #[must_use]
    pub fn take_camera_tiles(&mut self) -> Vec<CameraTile> {
        self.map.take_unkept()
    }

    /// Camera tiles could not be written. [`Server::take_camera_tiles`] hands them out again.
    pub fn camera_tiles_failed(&mut self, tiles: &[CameraTile]) {
        self.map.not_kept(tiles);
    }

    /// Whether [`Server::take_camera_tiles`] has something.
    pub fn has_camera_tiles(&self) -> bool {
        self.terms.stores && self.map.has_unkept()
    }

    /// Takes back a record that an earlier life of the server kept. The clock of this life must
    /// continue that one's, which the seconds in the record refer to.
    pub fn restore(&mut self, robot: RobotId, record: &TileRecord) {
        self.map.restore(robot, record);
    }

    /// Takes back what cameras had seen in an earlier life, as [`Server::restore`] does.
    pub fn restore_camera_tile(&mut self, tile: &CameraTile) {
        self.map.restore_camera_tile(tile);
    }

    /// Takes back how far the cure of a robot had come in an earlier life. It goes on.
    pub fn restore_cured(&mut self, record: &CureRecord) {
        self.corrections.restore(record);
        self.map.retire(record.robot, record.first_epoch);
    }
}
