//! The newest positions of robots, people and things.

use std::collections::BTreeMap;

use ubimap_protocol::{
    message::{Obstacle, Peer, Posture},
    time::{Duration, Instant},
    units::{Angle, Millimetres, Pose, RobotId},
};

use crate::{
    camera::Observation,
    perception::{Footprint, Lying, Track, Tracks},
    timing::{OUT_OF_VIEW, POSE_STALE, ROBOT_PARKED},
};

/// Maximum distance of the peers and obstacles sent to a robot, in metres.
const NEAR_M: f64 = 8.0;
/// The age that a silent robot's pose is given, in 10 ms: it has stopped by then, up to its way in this time
/// from there.
const PARKED_AGE: u8 = 200;

/// Distance, and angle of 2 degrees, within which a robot counts as standing: a correction of its pose may move
/// it a little.
const STANDS_WITHIN: (Millimetres, Angle) = (Millimetres(30), Angle(364));
/// Time between reports from one place after which a robot stands there.
const STANDS_AFTER: Duration = Duration::from_secs(1);

/// What is known of a robot's position.
#[derive(Clone, Copy, Debug)]
pub(super) struct Place {
    /// The newest pose and its time.
    pub(super) moment: Instant,
    pub(super) pose: Pose,
    /// Since when it is there.
    since: Instant,
    /// When a camera last saw it there or before.
    seen: Option<Instant>,
}

impl Place {
    /// Whether cameras saw the robot when its newest pose was taken, or shortly before.
    pub(super) fn is_in_view(&self) -> bool {
        self.seen.is_some_and(|seen| self.moment.since(seen) <= OUT_OF_VIEW)
    }

    /// Whether the robot stood when its newest pose was taken.
    pub(super) fn stands(&self) -> bool {
        self.moment.since(self.since) >= STANDS_AFTER
    }

    fn is_at(&self, pose: Pose) -> bool {
        let off = |from: Millimetres, to: Millimetres| (to - from).0.abs() <= STANDS_WITHIN.0.0;
        let turned = self.pose.heading.distance(pose.heading);
        off(self.pose.x, pose.x) && off(self.pose.y, pose.y) && turned <= STANDS_WITHIN.1.0
    }
}

/// Robots, people and things.
#[derive(Debug, Default)]
pub(super) struct Surroundings {
    robots: BTreeMap<RobotId, Place>,
    footprints: BTreeMap<RobotId, Footprint>,
    tracks: Tracks,
}

impl Surroundings {
    pub(super) fn set_footprint(&mut self, robot: RobotId, footprint: Footprint) {
        self.footprints.insert(robot, footprint);
    }

    pub(super) fn footprint(&self, robot: RobotId) -> Footprint {
        self.footprints.get(&robot).copied().unwrap_or_default()
    }

    /// Adds a pose that a robot told.
    pub(super) fn told(&mut self, robot: RobotId, moment: Instant, pose: Pose) {
        self.robot(robot, moment, pose);
    }

    /// Adds a pose at which a camera saw a robot.
    pub(super) fn saw(&mut self, robot: RobotId, captured: Instant, pose: Pose) {
        let known = self.robot(robot, captured, pose);
        known.seen = known.seen.max(Some(captured));
    }

    fn robot(&mut self, robot: RobotId, moment: Instant, pose: Pose) -> &mut Place {
        let place = Place { moment, pose, since: moment, seen: None };
        let known = self.robots.entry(robot).or_insert(place);
        if known.moment < moment {
            let since = if known.is_at(pose) { known.since } else { moment };
            *known = Place { moment, pose, since, seen: known.seen };
        }
        known
    }

    /// Where a robot was last.
    pub(super) fn place(&self, robot: RobotId) -> Option<Place> {
        self.robots.get(&robot).copied()
    }

    /// Forgets where a robot was.
    pub(super) fn forget(&mut self, robot: RobotId) {
        self.robots.remove(&robot);
    }

    /// Adds the things in a frame, whose cells have the side length `side`.
    pub(super) fn observe(&mut self, observation: &Observation, side: Millimetres) {
        let captured = observation.captured;
        // Things are only detected in frames with cells.
        if !observation.cells.is_empty() {
            self.tracks.observe(captured, &observation.things, side);
        }
    }

    /// Returns the next detection of a person lying on the floor; each one is returned once.
    pub(super) fn poll_lying(&mut self) -> Option<Lying> {
        self.tracks.poll_lying()
    }

    /// The newest pose of each robot, if it is at most [`POSE_STALE`] before or after `moment`.
    pub(super) fn whereabouts(&self, moment: Instant) -> impl Iterator<Item = (RobotId, Pose)> {
        let recent = self.robots.iter().filter(move |(_, place)| {
            moment.since(place.moment).max(place.moment.since(moment)) <= POSE_STALE
        });
        recent.map(|(&robot, place)| (robot, place.pose))
    }

    /// The time of the newest pose of any other robot; that of any robot while one stands silent somewhere.
    pub(super) fn peers_moment(&self, robot: RobotId) -> Option<Instant> {
        let newest = self.robots.values().map(|place| place.moment).max()?;
        let of_others = self.others(robot).map(|(_, moment, _)| moment);
        let is_parked = |moment: Instant| {
            let silent = newest.since(moment);
            silent > POSE_STALE && silent <= ROBOT_PARKED
        };
        if of_others.clone().any(is_parked) { Some(newest) } else { of_others.max() }
    }

    /// The other robots within [`NEAR_M`] of `robot`, nearest first: those with a recent pose, and those that
    /// fell silent and stand.
    pub(super) fn peers(&self, robot: RobotId) -> Vec<Peer> {
        let newest = self.peers_moment(robot).unwrap_or_default();
        let Some(&Place { pose: me, .. }) = self.robots.get(&robot) else { return Vec::new() };
        let there =
            self.others(robot).filter(|(_, moment, _)| newest.since(*moment) <= ROBOT_PARKED);
        let peers = there.map(|(id, moment, pose)| {
            let Footprint { half_length, half_width, .. } = self.footprint(id);
            let silent = newest.since(moment);
            let age = match silent <= POSE_STALE {
                true => (silent.micros() / 10_000).min(255) as u8,
                false => PARKED_AGE,
            };
            let peer = Peer { robot: id, pose, age, half_length, half_width };
            (distance_m(me, pose.x, pose.y), peer)
        });
        nearest_first(peers)
    }

    /// All known robots: where each was last, and its footprint.
    pub(super) fn robots(&self) -> impl Iterator<Item = (RobotId, Place, Footprint)> {
        self.robots.iter().map(|(&id, &place)| (id, place, self.footprint(id)))
    }

    /// All people and things, and the posture of each.
    pub(super) fn all_obstacles(&self) -> Vec<(Obstacle, Posture)> {
        self.tracks.now().map(|track| obstacle(&track)).collect()
    }

    /// The time of the obstacles' positions.
    pub(super) fn obstacles_moment(&self) -> Instant {
        self.tracks.moment()
    }

    /// The people and things within [`NEAR_M`] of `robot`, nearest first, and the posture of each.
    pub(super) fn obstacles(&self, robot: RobotId) -> Vec<(Obstacle, Posture)> {
        let Some(&Place { pose: me, .. }) = self.robots.get(&robot) else { return Vec::new() };
        let obstacles = self.tracks.now().map(|track| {
            let told = obstacle(&track);
            (distance_m(me, told.0.x, told.0.y), told)
        });
        nearest_first(obstacles)
    }

    fn others(&self, robot: RobotId) -> impl Iterator<Item = (RobotId, Instant, Pose)> + Clone {
        let others = self.robots.iter().filter(move |(id, _)| **id != robot);
        others.map(|(&id, place)| (id, place.moment, place.pose))
    }
}

fn obstacle(track: &Track) -> (Obstacle, Posture) {
    let [x, y] = track.position_m.map(Millimetres::from_metres);
    let millimetres = |metres: f64| (metres * 1000.0).round();
    // The casts saturate.
    let [velocity_x, velocity_y] = track.velocity_m_s.map(|it| millimetres(it) as i16);
    let obstacle = Obstacle {
        number: track.number,
        class: track.class(),
        x,
        y,
        velocity_x,
        velocity_y,
        radius: millimetres(track.radius_m) as u16,
    };
    (obstacle, track.posture())
}

fn distance_m(from: Pose, x: Millimetres, y: Millimetres) -> f64 {
    (x.metres() - from.x.metres()).hypot(y.metres() - from.y.metres())
}

fn nearest_first<T>(things: impl Iterator<Item = (f64, T)>) -> Vec<T> {
    let mut near: Vec<(f64, T)> = things.filter(|(distance, _)| *distance <= NEAR_M).collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    near.into_iter().map(|(_, thing)| thing).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_stands_after_a_second_at_one_place() {
        let mut about = Surroundings::default();
        let mut stands = |millis, x, heading| {
            let pose = Pose { x: Millimetres(x), y: Millimetres(0), heading: Angle(heading) };
            about.told(RobotId(1), Instant(0) + Duration::from_millis(millis), pose);
            about.place(RobotId(1)).unwrap().stands()
        };
        assert!(!stands(0, 0, 0));
        assert!(!stands(900, 10, 200) && stands(1_000, 0, 0) && stands(9_000, 0, 65_500));
        assert!(!stands(9_500, 40, 65_500), "it has driven");
        assert!(!stands(9_600, 40, 400) && !stands(10_550, 40, 400), "it has turned");
        assert!(stands(10_600, 40, 400));
        assert!(stands(9_700, 999, 400), "an old report");
    }

    #[test]
    fn a_robot_that_fell_silent_is_told_for_a_minute() {
        let mut about = Surroundings::default();
        let pose = |x| Pose { x: Millimetres(x), y: Millimetres(0), heading: Angle(0) };
        let (me, silent) = (RobotId(1), RobotId(2));
        about.told(silent, Instant(0), pose(1_000));
        let told = |about: &mut Surroundings, micros| {
            about.told(me, Instant(micros), pose(0));
            let ages: Vec<u8> = about.peers(me).iter().map(|peer| peer.age).collect();
            (ages, about.peers_moment(me))
        };
        let last = Instant(0) + POSE_STALE;
        assert_eq!(told(&mut about, last.0), (vec![0], Some(Instant(0))));
        // From now on each pose of this robot brings news of the silent one.
        let parked = Instant(0) + ROBOT_PARKED;
        for moment in [last + Duration(1), parked] {
            assert_eq!(told(&mut about, moment.0), (vec![PARKED_AGE], Some(moment)));
        }
        assert_eq!(about.peers(silent).len(), 1);
        assert_eq!(told(&mut about, parked.0 + 1), (vec![0], Some(Instant(0))));
    }
}
