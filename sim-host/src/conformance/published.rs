//! Rules for all that the peer has published. A failure shows the frame at fault.

use ubimap_protocol::message::{Digests, ToRobot, ToServer};

use super::{
    followed::{Followed, Update},
    halt::{Halt, Role},
    talk::{Seen, Talk},
};

impl Talk<'_> {
    /// What the peer has published.
    pub(super) fn followed(&self) -> &Followed {
        match self.role {
            Role::Robot => &self.server.followed,
            Role::Server => &self.robot.followed,
        }
    }

    /// Fails if an update could not be read.
    pub(super) fn must_be_readable(&mut self, expected: impl Into<String>) -> Result<(), Halt> {
        match self.followed().unread.first().cloned() {
            None => Ok(()),
            Some((why, carrier)) => self.fail_in(&carrier, expected, why),
        }
    }

    /// Fails if an update is as it must not be.
    pub(super) fn must_publish_none(
        &mut self,
        expected: impl Into<String>,
        is_wrong: impl FnMut(&&Update) -> bool,
    ) -> Result<(), Halt> {
        match self.followed().updates.iter().find(is_wrong).cloned() {
            None => Ok(()),
            Some(Update { carrier, layer, header, held, .. }) => {
                let found = format!("of layer {}, {header:?}, held {held:?}", layer as u8);
                self.fail_in(&carrier, expected, found)
            }
        }
    }

    /// Compares the digests in frames with the tiles that were published. Returns how many name a state that was.
    pub(super) fn must_agree(&mut self, frames: &[Seen]) -> Result<usize, Halt> {
        let mut compared = 0;
        for seen in frames {
            let all: Vec<Digests> = match self.role {
                Role::Robot => seen.bodies::<ToServer, _>().collect(),
                Role::Server => seen.bodies::<ToRobot, _>().collect(),
            };
            let named = all.iter().flat_map(|it| it.tiles.iter().map(|tile| (it.layer, *tile)));
            for (layer, tile) in named {
                let Some(held) = self.followed().hash(layer, tile.id, tile.stamp) else { continue };
                compared += 1;
                if let Some(carrier) = seen.carrier().filter(|_| held != tile.hash) {
                    let expected =
                        format!("the hash of {:?} {:?}: {held:08X}", tile.id, tile.stamp);
                    return self.fail_in(&carrier, expected, format!("{:08X}", tile.hash));
                }
            }
        }
        Ok(compared)
    }
}
