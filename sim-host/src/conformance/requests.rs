//! What the peer asks for: requests for tiles of which it lacks the base, or whose digest differs.

use ubimap_protocol::{
    message::{Request, ToRobot, ToServer},
    tile::{Layer, TileId},
    time::Duration,
};

use super::{
    halt::{Halt, Role, fail},
    talk::{Seen, Talk},
};

impl Talk<'_> {
    /// The requests in a frame for tiles that the runner writes: fused ones as a server, its own as a robot.
    fn requests(&self, seen: &Seen) -> Vec<Request> {
        let (all, layer): (Vec<Request>, Layer) = match self.role {
            Role::Robot => (seen.bodies::<ToServer, _>().collect(), Layer::Fused),
            Role::Server => (seen.bodies::<ToRobot, _>().collect(), Layer::Robot),
        };
        all.into_iter().filter(|it| it.layer == layer).collect()
    }

    /// Fails unless the peer requests a tile within a second, or does not, as `wanted` says.
    pub(super) fn must_request(
        &mut self,
        id: TileId,
        wanted: bool,
        what: &str,
    ) -> Result<(), Halt> {
        let names = |request: &Request| request.tiles.is_empty() || request.tiles.contains(&id);
        let span = Duration::from_secs(1) + self.slack();
        let request = self.find(span, |talk, seen| talk.requests(seen).iter().any(names))?;
        let word = |is: bool| if is { "a Request for the tile" } else { "no Request" };
        match request.is_some() {
            found if found == wanted => Ok(()),
            found => fail(format!("after {what}: {}", word(wanted)), word(found)),
        }
    }
}
