//! What the server wants of the robot, and what it tells of its surroundings: the newest of each
//! kind.

use ubimap_protocol::message::{Obstacles, Path, Peers, Stop};

/// The newest commands and surroundings.
#[derive(Clone, Debug, Default)]
pub struct Commands {
    stop: Option<Stop>,
    path: Option<Path>,
    peers: Option<Peers>,
    obstacles: Option<Obstacles>,
}

impl Commands {
    /// Takes a stop; an older one than is known is passed over.
    pub(crate) fn take_stop(&mut self, stop: Stop) {
        if self.stop.is_none_or(|known| known.number < stop.number) {
            self.stop = Some(stop);
        }
    }

    /// Takes a path; an older one than is known is passed over.
    pub(crate) fn take_path(&mut self, path: Path) {
        if self.path.as_ref().is_none_or(|known| known.number < path.number) {
            self.path = Some(path);
        }
    }

    /// Takes the other robots; older ones than are known are passed over.
    pub(crate) fn take_peers(&mut self, peers: Peers) {
        if self.peers.as_ref().is_none_or(|known| known.time < peers.time) {
            self.peers = Some(peers);
        }
    }

    /// Takes obstacles; older ones than are known are passed over.
    pub(crate) fn take_obstacles(&mut self, obstacles: Obstacles) {
        if self.obstacles.as_ref().is_none_or(|known| known.time < obstacles.time) {
            self.obstacles = Some(obstacles);
        }
    }

    /// Another life of the server counts anew.
    pub(crate) fn forget(&mut self) {
        *self = Self::default();
    }

    /// Whether the server wants the robot to stand.
    pub fn must_stop(&self) -> bool {
        self.stop.is_some_and(|stop| stop.stop)
    }

    /// Where to drive, if the server said so.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_ref()
    }

    /// The other robots, if the server told of any.
    pub fn peers(&self) -> Option<&Peers> {
        self.peers.as_ref()
    }

    /// What stands or moves about, if the server told of any.
    pub fn obstacles(&self) -> Option<&Obstacles> {
        self.obstacles.as_ref()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_highest_number_holds_in_any_order() {
        let mut commands = Commands::default();
        commands.take_stop(Stop { number: 2, stop: true });
        commands.take_stop(Stop { number: 1, stop: false });
        assert!(commands.must_stop());
        commands.take_stop(Stop { number: 3, stop: false });
        assert!(!commands.must_stop());
    }
}
