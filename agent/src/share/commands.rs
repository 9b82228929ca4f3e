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
    /// Stores a stop, path, peers or obstacles message, unless it is superseded by the stored one.
    /// Returns `None` if the message is malformed or of another kind.
    // Not inlined: these are the longest messages, and decoding them would enlarge the stack frame
    // in which every other message is processed.
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
    use ubimap_protocol::{
        message::{Body, Message, Messages, Reset, ToRobot, ToRobotKind, Waypoint, Writer},
        time::Instant,
        units::Millimetres,
    };

    fn take(commands: &mut Commands, body: &impl Body<ToRobot>) -> Option<()> {
        let mut buffer = [0; 40];
        let mut writer = Writer::<ToRobot>::new(&mut buffer);
        assert!(writer.push(body));
        let message = Messages::<ToRobot>::new(&buffer).next().unwrap().unwrap();
        commands.take(message.by_kind().unwrap())
    }

    #[test]
    fn the_highest_number_wins_in_any_order() {
        let mut commands = Commands::default();
        for (number, stop, must_stop) in
            [(2, true, true), (1, false, true), (2, false, true), (3, false, false)]
        {
            assert_eq!(take(&mut commands, &Stop { number, stop }), Some(()));
            assert_eq!(commands.must_stop(), must_stop, "{number}");
        }
        let waypoint = Waypoint { x: Millimetres(1), y: Millimetres(2) };
        let path = |number: u32, points: usize| Path {
            number,
            waypoints: core::iter::repeat_n(waypoint, points).collect(),
        };
        for (number, points, kept) in
            [(2, 1, (2, 1)), (1, 2, (2, 1)), (2, 3, (2, 1)), (3, 4, (3, 4))]
        {
            assert_eq!(take(&mut commands, &path(number, points)), Some(()));
            assert_eq!(commands.path(), Some(&path(kept.0, kept.1)), "{number}");
        }
    }

    #[test]
    fn the_newest_report_wins_in_any_order_until_the_server_restarts() {
        let mut commands = Commands::default();
        for (time, newest) in [(2, 2), (1, 2), (3, 3)].map(|(a, b)| (Instant(a), Instant(b))) {
            let peers = Peers { time, peers: Default::default() };
            let obstacles = Obstacles::with_postures(time, core::iter::empty());
            assert_eq!(take(&mut commands, &peers), Some(()));
            assert_eq!(take(&mut commands, &obstacles), Some(()));
            assert_eq!(commands.peers().map(|peers| peers.time), Some(newest));
            assert_eq!(commands.obstacles().map(|obstacles| obstacles.time), Some(newest));
        }
        assert_eq!(take(&mut commands, &Stop { number: 9, stop: true }), Some(()));
        commands.forget();
        assert!(!commands.must_stop() && commands.path().is_none());
        assert!(commands.peers().is_none() && commands.obstacles().is_none());
    }

    #[test]
    fn other_and_malformed_messages_are_refused() {
        let mut commands = Commands::default();
        assert_eq!(take(&mut commands, &Reset), None);
        let stop = Message::<ToRobot>::new(ToRobotKind::Stop.into(), &[1]);
        assert_eq!(commands.take(stop.by_kind().unwrap()), None);
        assert!(!commands.must_stop());
    }
}
