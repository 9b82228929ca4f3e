//! Whether all maps have converged.

use ubimap_protocol::tile::{Layer, Stamp, tile_hash};

use super::{fleet::Fleet, member::Member};

impl Fleet<'_> {
    /// Whether the server holds the newest version of every published tile, every fused tile on a
    /// robot equals the server's newest (by hash), and nothing is left to store. Of a robot outside
    /// only what it has acknowledged is known.
    pub fn has_converged(&self) -> bool {
        !self.deployment().has_unsaved()
            && self.outside().is_none_or(|robot| self.server().is_level(robot.id()))
            && self.robots().iter().all(|robot| {
                robot.robot().is_idle()
                    && self.server().is_level(robot.id())
                    && self.server_holds_all_of(robot)
                    && self.all_held_is_newest(robot)
            })
    }

    fn server_holds_all_of(&self, robot: &Member<'_>) -> bool {
        let Some(layer) = self.server().layer(robot.id()) else {
            return robot.robot().own_tiles().tiles().next().is_none();
        };
        robot.robot().own_tiles().tiles().all(|tile| {
            let stamp = Stamp { epoch: tile.epoch(), version: tile.publication().version() };
            let held = tile.id().and_then(|id| layer.held(id, tile.epoch()));
            held.is_some_and(|(held, cells)| {
                held == stamp && tile_hash(cells) == tile_hash(tile.publication().sent())
            })
        })
    }

    fn all_held_is_newest(&self, robot: &Member<'_>) -> bool {
        robot.robot().fused_tiles().tiles(Layer::Fused).all(|(id, replica)| {
            let newest = self.server().fused().get(id);
            newest.is_some_and(|(version, cells)| {
                let stamp = Stamp { epoch: self.server().epoch(), version };
                !replica.is_partial()
                    && replica.stamp() == stamp
                    && tile_hash(replica.tile()) == tile_hash(cells)
            })
        })
    }
}
