//! What a robot is told of its surroundings, of the server's own accord: newest state, and never
//! again.

use ubimap_protocol::{
    message::{MAX_OBSTACLES, MAX_PEERS, Obstacles, Peers, ToRobotKind, Writer},
    time::{Duration, Instant},
    units::RobotId,
};

use super::surroundings::Surroundings;

/// Each kind of news is told at most this often.
const INTERVAL: Duration = Duration::from_millis(200);
/// News are kept to this rate, so that tiles have some of the budget left.
const BYTES_PER_SECOND: u64 = 600;

/// What one robot has been told.
#[derive(Debug, Default)]
pub(super) struct News {
    peers: Told,
    obstacles: Told,
    /// When all that was sent is paid for.
    ready_at: Instant,
    left_out: u64,
}

/// The newest list that was told.
#[derive(Debug, Default)]
struct Told {
    /// Its moment.
    moment: Option<Instant>,
    /// Whether there was anything in it.
    any: bool,
    /// When the next one may follow.
    next: Instant,
}

impl News {
    /// Peers and obstacles that lists had no room for, each time.
    pub(super) fn left_out(&self) -> u64 {
        self.left_out
    }

    /// When there is something to tell.
    pub(super) fn poll_timeout(&self, about: &Surroundings, robot: RobotId) -> Option<Instant> {
        let peers = self.peers.due(about.peers_moment(robot));
        let obstacles = self.obstacles.due(Some(about.obstacles_moment()));
        let due = peers.into_iter().chain(obstacles).min()?;
        Some(due.max(self.ready_at))
    }

    /// Adds what is due. A list is cut only where it has a frame to itself.
    pub(super) fn fill(
        &mut self,
        about: &Surroundings,
        robot: RobotId,
        now: Instant,
        writer: &mut Writer<'_>,
        mut alone: bool,
    ) {
        if self.ready_at > now {
            return;
        }
        let before = writer.len();
        let moment = about.peers_moment(robot);
        if let (Some(time), true) = (moment, self.peers.due(moment).is_some_and(|due| due <= now)) {
            let told = self.peers.tell(time, now, about.peers(robot), MAX_PEERS, alone, |some| {
                let peers = some.iter().copied().collect();
                writer.push(ToRobotKind::Peers as u8, &Peers { time, peers })
            });
            self.left_out += told as u64;
            alone &= writer.len() == before;
        }
        let time = about.obstacles_moment();
        if self.obstacles.due(Some(time)).is_some_and(|due| due <= now) {
            let list = about.obstacles(robot);
            let told = self.obstacles.tell(time, now, list, MAX_OBSTACLES, alone, |some| {
                let obstacles = some.iter().copied().collect();
                writer.push(ToRobotKind::Obstacles as u8, &Obstacles { time, obstacles })
            });
            self.left_out += told as u64;
        }
        let bytes = (writer.len() - before) as u64;
        self.ready_at = now + Duration(bytes * 1_000_000 / BYTES_PER_SECOND);
    }
}

impl Told {
    /// When a list of this moment may be told, if it is news.
    fn due(&self, moment: Option<Instant>) -> Option<Instant> {
        moment.filter(|moment| Some(*moment) > self.moment).map(|_| self.next)
    }

    /// Tells a list, or as much of its beginning as there is room for; one that is empty only after
    /// one that was not. How many were left out.
    fn tell<T>(
        &mut self,
        moment: Instant,
        now: Instant,
        list: Vec<T>,
        most: usize,
        alone: bool,
        mut push: impl FnMut(&[T]) -> bool,
    ) -> usize {
        let longest = list.len().min(most);
        let shortest = if alone { longest.min(1) } else { longest };
        let told = match list.is_empty() && !self.any {
            true => Some(0),
            false => (shortest..=longest).rev().find(|&count| push(&list[..count])),
        };
        if told.is_none() && !alone {
            // It will have the next frame to itself.
            return 0;
        }
        let count = told.unwrap_or(0);
        *self = Self { moment: Some(moment), any: count > 0, next: now + INTERVAL };
        list.len() - count
    }
}
