//! The newest commands and reports of the server, one of each kind.

use serde::de::DeserializeOwned;
use ubimap_protocol::message::{Encoded, Obstacles, Path, Peers, Stop, ToRobotMessage};

/// The newest commands and reports of the server.
#[derive(Clone, Debug, Default)]
pub struct Commands {
    stop: Option<Stop>,
    path: Option<Path>,
    peers: Option<Peers>,
    obstacles: Option<Obstacles>,
}

impl Commands {
    /// Processes a message of one of these kinds; superseded messages are ignored. Returns `None`
    /// if the message is malformed or of another kind.
    // Not inlined: these are the longest messages, and would enlarge the stack frame of all others.
    #[inline(never)]
    pub(crate) fn take(&mut self, message: ToRobotMessage<'_>) -> Option<()> {
        match message {
            ToRobotMessage::Stop(stop) => {
                keep(&mut self.stop, stop, |known, stop| known.number < stop.number)
            }
            ToRobotMessage::Path(path) => {
                keep(&mut self.path, path, |known, path| known.number < path.number)
            }
            ToRobotMessage::Peers(peers) => {
                keep(&mut self.peers, peers, |known, peers| known.time < peers.time)
            }
            ToRobotMessage::Obstacles(obstacles) => {
                keep(&mut self.obstacles, obstacles, |known, obstacles| known.time < obstacles.time)
            }
            _ => None,
        }
    }

    /// Forgets everything: a restarted server numbers its messages from the start.
    pub(crate) fn forget(&mut self) {
        *self = Self::default();
    }

    /// Whether the server has commanded a stop.
    pub fn must_stop(&self) -> bool {
        self.stop.is_some_and(|stop| stop.stop)
    }

    /// The path to drive, if the server has sent one.
    pub fn path(&self) -> Option<&Path> {
        self.path.as_ref()
    }

    /// The other robots, if the server has reported any.
    pub fn peers(&self) -> Option<&Peers> {
        self.peers.as_ref()
    }

    /// The obstacles, standing or moving, if the server has reported any.
    pub fn obstacles(&self) -> Option<&Obstacles> {
        self.obstacles.as_ref()
    }
}

/// Stores a message if it is newer than the stored one.
fn keep<T: DeserializeOwned>(
    known: &mut Option<T>,
    message: Encoded<'_, T>,
    is_newer: impl FnOnce(&T, &T) -> bool,
) -> Option<()> {
    let told = message.decode().ok()?;
    if known.as_ref().is_none_or(|known| is_newer(known, &told)) {
        *known = Some(told);
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::message::{Messages, ToRobot, Writer};

    #[test]
    fn the_highest_number_wins_in_any_order() {
        let mut commands = Commands::default();
        let mut take = |number, stop| {
            let mut buffer = [0; 16];
            let mut writer = Writer::<ToRobot>::new(&mut buffer);
            assert!(writer.push(&Stop { number, stop }));
            let message = Messages::<ToRobot>::new(&buffer).next().unwrap().unwrap();
            assert_eq!(commands.take(message.by_kind().unwrap()), Some(()));
            commands.must_stop()
        };
        assert!(take(2, true));
        assert!(take(1, false));
        assert!(!take(3, false));
    }
}
