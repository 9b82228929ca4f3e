//! Tiles that have lost what a robot had drawn there. Other robots that agreed with the map were silent,
//! and may know these cells: they are asked for their tiles once the changed map has reached them.

use std::collections::{BTreeMap, BTreeSet};

use ubimap_protocol::{tile::TileId, units::RobotId};

use super::session::Session;

/// The tiles, and which robots have been asked for them.
#[derive(Debug, Default)]
pub(super) struct Voided {
    /// Number of the last loss of each tile; losses count up from one.
    tiles: BTreeMap<TileId, u32>,
    losses: u32,
    /// The last loss up to which each robot has been asked, zero if not listed.
    asked: BTreeMap<RobotId, u32>,
    /// The last tile that was requested of a robot that has not been asked for all yet.
    next: BTreeMap<RobotId, TileId>,
}

impl Voided {
    /// Adds tiles in which a robot's observations were voided. That robot may have agreed with them, too,
    /// since it began anew.
    pub(super) fn add(&mut self, tiles: &BTreeSet<TileId>) {
        self.losses += 1;
        self.tiles.extend(tiles.iter().map(|&id| (id, self.losses)));
        self.next.clear();
    }

    /// Whether a robot must be asked.
    pub(super) fn concerns(&self, robot: RobotId) -> bool {
        self.losses > self.asked_up_to(robot)
    }

    /// Requests the tiles from a robot that holds the newest state of the map, as far as there is room
    /// for requests.
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
