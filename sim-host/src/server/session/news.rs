//! Delivery of peers and obstacles to one robot: only the newest list is sent, without
//! retransmission.

use std::ops::RangeInclusive;

use ubimap_protocol::{
    message::{MAX_OBSTACLES, MAX_PEERS, Obstacles, Peers, ToRobot, Writer},
    time::{Duration, Instant},
    units::RobotId,
};

use crate::server::surroundings::Surroundings;

/// Minimum interval between lists of one kind.
const INTERVAL: Duration = Duration::from_millis(200);
/// Maximum average rate of lists in bytes per second. It leaves most of the budget for tiles.
const BYTES_PER_SECOND: u64 = 600;

/// The lists sent to one robot.
#[derive(Debug, Default)]
pub(super) struct News {
    peers: Told,
    obstacles: Told,
    /// When the next list is within the average rate.
    ready_at: Instant,
    left_out: u64,
}

/// The last list of a kind that was sent.
#[derive(Debug, Default)]
struct Told {
    /// The time of the positions in the list.
    moment: Option<Instant>,
    /// Whether the list had any elements.
    any: bool,
    /// The earliest time for the next list.
    next: Instant,
}

impl News {
    /// Number of peers and obstacles left out of lists, summed over all lists.
    pub(super) fn left_out(&self) -> u64 {
        self.left_out
    }

    /// When the next list is due.
    pub(super) fn poll_timeout(&self, about: &Surroundings, robot: RobotId) -> Option<Instant> {
        let peers = self.peers.due(about.peers_moment(robot));
        let obstacles = self.obstacles.due(Some(about.obstacles_moment()));
        let due = peers.into_iter().chain(obstacles).min()?;
        Some(due.max(self.ready_at))
    }

    /// Adds the due lists to a frame. A list is truncated only if it has the frame to itself;
    /// `alone` says whether the frame is still empty.
    pub(super) fn fill(
        &mut self,
        about: &Surroundings,
        robot: RobotId,
        now: Instant,
        writer: &mut Writer<'_, ToRobot>,
        mut alone: bool,
    ) {
        if self.ready_at > now {
            return;
        }
        let before = writer.len();
        let moment = about.peers_moment(robot);
        if let (Some(time), true) = (moment, self.peers.due(moment).is_some_and(|due| due <= now)) {
            let list = about.peers(robot);
            let told = self.peers.tell(time, now, list.len().min(MAX_PEERS), alone, |counts| {
                let peers = |count: usize| list[..count].iter().copied().collect();
                writer.push_longest(counts, |count| Peers { time, peers: peers(count) })
            });
            self.left_out += told.map_or(0, |told| list.len() - told) as u64;
            alone &= writer.len() == before;
        }
        let time = about.obstacles_moment();
        if self.obstacles.due(Some(time)).is_some_and(|due| due <= now) {
            let list = about.obstacles(robot);
            let most = list.len().min(MAX_OBSTACLES);
            let told = self.obstacles.tell(time, now, most, alone, |counts| {
                let obstacles = |count: usize| list[..count].iter().copied();
                writer
                    .push_longest(counts, |count| Obstacles::with_postures(time, obstacles(count)))
            });
            self.left_out += told.map_or(0, |told| list.len() - told) as u64;
        }
        let bytes = (writer.len() - before) as u64;
        self.ready_at = now + Duration(bytes * 1_000_000 / BYTES_PER_SECOND);
    }
}

impl Told {
    /// When a list with positions of the time `moment` may be sent; `None` if they are not newer
    /// than those of the last list.
    fn due(&self, moment: Option<Instant>) -> Option<Instant> {
        moment.filter(|moment| Some(*moment) > self.moment).map(|_| self.next)
    }

    /// Sends a list of up to `longest` elements, truncated to fit if `alone`. An empty list is sent
    /// only after one with elements. `push` adds the longest list that fits, within a range of
    /// lengths, and returns its length. Returns the number of elements sent; `None` if the list
    /// must wait for a frame of its own.
    fn tell(
        &mut self,
        moment: Instant,
        now: Instant,
        longest: usize,
        alone: bool,
        push: impl FnOnce(RangeInclusive<usize>) -> Option<usize>,
    ) -> Option<usize> {
        let shortest = if alone { longest.min(1) } else { longest };
        let is_news = longest > 0 || self.any;
        let told = if is_news { push(shortest..=longest) } else { Some(0) };
        let count = told.or(alone.then_some(0))?;
        *self = Self { moment: Some(moment), any: count > 0, next: now + INTERVAL };
        Some(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ubimap_protocol::{message::Messages, units::Pose};

    const ME: RobotId = RobotId(1);

    fn second(second: u64) -> Instant {
        Instant(second * 1_000_000)
    }

    /// Robots 1 to `robots`, at 1 m intervals to the east of a distant point.
    fn saw(about: &mut Surroundings, robots: u16, at: Instant) {
        let pose = |robot: u16| Pose::from_metres(200_000.0 + f64::from(robot), 0.0, 0.0);
        (1..=robots).for_each(|robot| about.told(RobotId(robot), at, pose(robot)));
    }

    /// The robots listed in the next frame, which has `room` bytes, if it contains a list.
    fn told(
        news: &mut News,
        about: &Surroundings,
        now: Instant,
        room: usize,
        alone: bool,
    ) -> Option<Vec<u16>> {
        let mut frame = vec![0; room];
        let mut writer = Writer::new(&mut frame);
        news.fill(about, ME, now, &mut writer, alone);
        let len = writer.len();
        let message = Messages::<ToRobot>::new(&frame[..len]).next()?.unwrap();
        let peers = message.decode::<Peers>().unwrap().peers;
        Some(peers.iter().map(|peer| peer.robot.0).collect())
    }

    #[test]
    fn the_nearest_are_sent_and_the_others_counted() {
        let (mut news, mut about) = (News::default(), Surroundings::default());
        saw(&mut about, 30, second(1));
        assert_eq!(
            told(&mut news, &about, second(1), 60, false),
            None,
            "with other messages in the frame"
        );
        // All of them are within 8 m, in order of distance.
        let near = vec![2, 3, 4, 5, 6, 7, 8, 9];
        assert_eq!(told(&mut news, &about, second(1), 242, true), Some(near));
        assert_eq!(news.left_out(), 0);
        saw(&mut about, 30, second(2));
        assert_eq!(told(&mut news, &about, second(2), 24, true), Some(vec![2]));
        assert_eq!(news.left_out(), 7);
        saw(&mut about, 30, second(3));
        assert_eq!(told(&mut news, &about, second(3), 10, true), None);
        assert_eq!(news.left_out(), 15, "peers left out are counted");
    }

    #[test]
    fn only_the_newest_list_is_sent_and_an_empty_one_once() {
        let (mut news, mut about) = (News::default(), Surroundings::default());
        let tell = |news: &mut News, about: &Surroundings, millis: u64| {
            told(news, about, Instant(millis * 1_000), 242, true)
        };
        saw(&mut about, 2, second(1));
        assert_eq!(tell(&mut news, &about, 1_000), Some(vec![2]));
        saw(&mut about, 3, Instant(1_050_000));
        assert_eq!(tell(&mut news, &about, 1_100), None, "too soon");
        saw(&mut about, 2, Instant(1_100_000));
        let due = news.poll_timeout(&about, ME).unwrap();
        assert_eq!(due, Instant(1_200_000));
        assert_eq!(tell(&mut news, &about, 1_200), Some(vec![2, 3]));
        assert_eq!(news.poll_timeout(&about, ME), None);
        // Robot 9 is far away, and the others have been silent for more than a minute.
        let far = Pose::from_metres(0.0, 0.0, 0.0);
        about.told(RobotId(9), second(65), far);
        assert_eq!(tell(&mut news, &about, 65_000), Some(vec![]));
        about.told(RobotId(9), second(66), far);
        assert_eq!(tell(&mut news, &about, 66_000), None);
        assert_eq!(news.poll_timeout(&about, ME), None);
    }

    #[test]
    fn long_lists_are_sent_less_often() {
        let (mut news, mut about) = (News::default(), Surroundings::default());
        let mut bytes = 0;
        for step in 0..1_000 {
            let now = Instant(step * 10_000);
            saw(&mut about, 9, now);
            let mut frame = [0; 242];
            let mut writer = Writer::new(&mut frame);
            news.fill(&about, ME, now, &mut writer, true);
            bytes += writer.len();
        }
        assert!((5_000..=6_200).contains(&bytes), "{bytes} bytes in ten seconds");
    }
}
