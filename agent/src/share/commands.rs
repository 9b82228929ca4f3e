//! What the server wants of the robot, and what it tells of its surroundings: the newest of each
//! kind.

use serde::de::DeserializeOwned;
use ubimap_protocol::message::{Obstacles, Path, Peers, Stop, ToRobotKind, decode};

/// The newest commands and surroundings.
#[derive(Clone, Debug, Default)]
pub struct Commands {
    stop: Option<Stop>,
    path: Option<Path>,
    peers: Option<Peers>,
    obstacles: Option<Obstacles>,
}

impl Commands {
    /// Takes a message of these kinds; one that is older than what is known is passed over. `None`
    /// if it cannot be read.
    // Apart from other messages: read, these are the longest, and would be on the stack below all.
    #[inline(never)]
    pub(crate) fn take(&mut self, kind: ToRobotKind, body: &[u8]) -> Option<()> {
        match kind {
            ToRobotKind::Stop => {
                keep(&mut self.stop, body, |known, stop| known.number < stop.number)
            }
            ToRobotKind::Path => {
                keep(&mut self.path, body, |known, path| known.number < path.number)
            }
            ToRobotKind::Peers => {
                keep(&mut self.peers, body, |known, peers| known.time < peers.time)
            }
            ToRobotKind::Obstacles => {
                keep(&mut self.obstacles, body, |known, obstacles| known.time < obstacles.time)
            }
            _ => None,
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

/// Keeps a message if it is newer than the one that is known.
fn keep<T: DeserializeOwned>(
    known: &mut Option<T>,
    body: &[u8],
    is_newer: impl FnOnce(&T, &T) -> bool,
) -> Option<()> {
    let (told, _) = decode(body).ok()?;
    if known.as_ref().is_none_or(|known| is_newer(known, &told)) {
        *known = Some(told);
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::message::{Messages, Writer};

    #[test]
    fn the_highest_number_holds_in_any_order() {
        let mut commands = Commands::default();
        let mut take = |number, stop| {
            let mut buffer = [0; 16];
            let mut writer = Writer::new(&mut buffer);
            assert!(writer.push(ToRobotKind::Stop as u8, &Stop { number, stop }));
            let message = Messages::new(&buffer).next().unwrap().unwrap();
            assert_eq!(commands.take(ToRobotKind::Stop, message.body), Some(()));
            commands.must_stop()
        };
        assert!(take(2, true));
        assert!(take(1, false));
        assert!(!take(3, false));
    }
}
