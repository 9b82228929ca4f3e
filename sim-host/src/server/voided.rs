//! Tiles in which a robot's observations were voided. Other robots may know these cells without
//! having reported them, because robots report nothing while they agree with the map. So they are
//! asked for their tiles once the changed map has reached them.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{tile::TileId, units::RobotId};

use super::session::Session;

/// The tiles, and which robots have been asked for them.
#[derive(Debug, Default)]
pub(super) struct Voided {
    /// The number of the last loss in which each tile was voided. Losses are numbered from one.
    tiles: BTreeMap<TileId, u32>,
    losses: u32,
    /// The number of the last loss for which each robot has been asked for all tiles; zero if not
    /// listed.
    asked: BTreeMap<RobotId, u32>,
    /// The last tile that was requested from each robot that has not been asked for all tiles yet.
    next: BTreeMap<RobotId, TileId>,
}

impl Voided {
    /// Adds tiles in which a robot's observations were voided. That robot is asked, too: since its
    /// restart it may have seen these cells and agreed with the map.
    pub(super) fn add(&mut self, tiles: &BTreeSet<TileId>) {
        self.losses += 1;
        self.tiles.extend(tiles.iter().map(|&id| (id, self.losses)));
        self.next.clear();
    }

    /// Whether a robot has not been asked for all of the tiles yet.
    pub(super) fn concerns(&self, robot: RobotId) -> bool {
        self.losses > self.asked_up_to(robot)
    }

    /// Requests the tiles from a robot that holds the newest state of the map. If there is no room
    /// for more requests, the next call continues.
    pub(super) fn ask(&mut self, session: &mut Session) {
        let robot = session.robot();
        let last = self.next.get(&robot).copied();
        let asked = self.asked_up_to(robot);
        for (&id, _) in self.tiles.iter().filter(|&(&id, &loss)| loss > asked && Some(id) > last) {
            if !session.ask_for(id) {
                return;
            }
            self.next.insert(robot, id);
        }
        self.asked.insert(robot, self.losses);
        self.next.remove(&robot);
    }

    /// Forgets a robot.
    pub(super) fn forget(&mut self, robot: RobotId) {
        self.asked.remove(&robot);
        self.next.remove(&robot);
    }

    fn asked_up_to(&self, robot: RobotId) -> u32 {
        self.asked.get(&robot).copied().unwrap_or(0)
    }
}
