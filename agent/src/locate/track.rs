//! Poses over time: the last few of them, and the pose in between.

use heapless::Deque;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose},
};

/// The last `N` poses of one kind (fixes, odometry), each with its moment, oldest first.
#[derive(Debug, Default)]
pub struct Track<const N: usize> {
    poses: Deque<(Instant, Pose), N>,
}

/// The poses next to a moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Around {
    /// The newest at the moment or before it.
    pub before: Option<(Instant, Pose)>,
    /// The oldest after it.
    pub after: Option<(Instant, Pose)>,
}

impl<const N: usize> Track<N> {
    /// Adds a pose, wherever it belongs in time; the oldest gives way. A moment that is there
    /// already keeps its pose. `false` if nothing was added.
    pub fn insert(&mut self, moment: Instant, pose: Pose) -> bool {
        if self.poses.iter().any(|&(other, _)| other == moment) {
            return false;
        }
        if self.poses.is_full() {
            if self.poses.front().is_none_or(|&(oldest, _)| moment < oldest) {
                return false;
            }
            self.poses.pop_front();
        }
        if self.poses.push_back((moment, pose)).is_err() {
            return false;
        }
        // Sink it to its place: nearly always it is there already.
        let mut entries = self.poses.iter_mut().rev();
        let mut new = entries.next();
        for earlier in entries {
            let Some(later) = new.filter(|later| earlier.0 > later.0) else { break };
            core::mem::swap(earlier, later);
            new = Some(earlier);
        }
        true
    }

    /// Forgets all of them.
    pub fn clear(&mut self) {
        self.poses.clear();
    }

    /// The newest pose.
    pub fn newest(&self) -> Option<(Instant, Pose)> {
        self.poses.back().copied()
    }

    /// The poses next to a moment.
    pub fn around(&self, moment: Instant) -> Around {
        let before = self.poses.iter().rev().find(|(time, _)| *time <= moment).copied();
        let after = self.poses.iter().find(|(time, _)| *time > moment).copied();
        Around { before, after }
    }
}

impl Around {
    /// How far apart the two are in time, if there are two.
    pub fn gap(&self) -> Option<Duration> {
        Some(self.after?.0.since(self.before?.0))
    }

    /// The pose at a moment between the two, in proportion; the one before if it is of that very
    /// moment. `None` if there are not two.
    pub fn at(&self, moment: Instant) -> Option<Pose> {
        let (start, from) = self.before?;
        if start == moment {
            return Some(from);
        }
        let (end, to) = self.after?;
        let (part, whole) = (moment.since(start).0 as i64, end.since(start).0 as i64);
        let mix = |from: i32, to: i32| {
            let step = (i64::from(to) - i64::from(from)) * part / whole.max(1);
            (i64::from(from) + step) as i32
        };
        let turn = i64::from((to.heading - from.heading).0 as i16) * part / whole.max(1);
        Some(Pose {
            x: Millimetres(mix(from.x.0, to.x.0)),
            y: Millimetres(mix(from.y.0, to.y.0)),
            heading: Angle(from.heading.0.wrapping_add(turn as u16)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(x: i32, heading: u16) -> Pose {
        Pose { x: Millimetres(x), y: Millimetres(-x), heading: Angle(heading) }
    }

    #[test]
    fn late_poses_find_their_place() {
        let mut track = Track::<3>::default();
        for moment in [50, 10, 30] {
            assert!(track.insert(Instant(moment), pose(moment as i32, 0)));
        }
        assert!(!track.insert(Instant(30), pose(0, 0)));
        assert!(!track.insert(Instant(5), pose(0, 0)));
        assert_eq!(track.around(Instant(40)).gap(), Some(Duration(20)));
        assert!(track.insert(Instant(40), pose(40, 0)));
        assert_eq!(track.around(Instant(20)).before, None);
        assert_eq!(track.newest(), Some((Instant(50), pose(50, 0))));
    }

    #[test]
    fn the_pose_in_between_is_in_proportion_and_turns_the_short_way() {
        let mut track = Track::<4>::default();
        track.insert(Instant(0), pose(0, 65_000));
        track.insert(Instant(100), pose(1000, 536));
        let at = |moment| track.around(Instant(moment)).at(Instant(moment));
        assert_eq!(at(0), Some(pose(0, 65_000)));
        assert_eq!(at(25), Some(pose(250, 65_268)));
        assert_eq!(at(75), Some(pose(750, 268)));
        assert_eq!(at(101), None);
    }
}
