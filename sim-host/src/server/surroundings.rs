//! The newest positions of robots, people and things.

use std::collections::BTreeMap;

use ubimap_protocol::{
    message::{Obstacle, Peer, Posture},
    time::Instant,
    units::{Millimetres, Pose, RobotId},
};

use crate::{
    camera::Observation,
    perception::{Footprint, Lying, Track, Tracks},
    timing::POSE_STALE,
};

/// Maximum distance of the peers and obstacles sent to a robot, in metres.
const NEAR_M: f64 = 8.0;

/// Robots, people and things.
#[derive(Debug, Default)]
pub(super) struct Surroundings {
    robots: BTreeMap<RobotId, (Instant, Pose)>,
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

    /// Adds a pose of a robot.
    pub(super) fn robot(&mut self, robot: RobotId, moment: Instant, pose: Pose) {
        let known = self.robots.entry(robot).or_insert((moment, pose));
        if known.0 < moment {
            *known = (moment, pose);
        }
    }

    /// Where a robot was last, and when.
    pub(super) fn newest(&self, robot: RobotId) -> Option<(Instant, Pose)> {
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
        let recent = self
            .robots
            .iter()
            .filter(move |(_, (at, _))| moment.since(*at).max(at.since(moment)) <= POSE_STALE);
        recent.map(|(&robot, &(_, pose))| (robot, pose))
    }

    /// The newest pose of a robot and its time.
    pub(super) fn last_pose(&self, robot: RobotId) -> Option<(Instant, Pose)> {
        self.robots.get(&robot).copied()
    }

    /// The time of the newest pose of any other robot.
    pub(super) fn peers_moment(&self, robot: RobotId) -> Option<Instant> {
        self.others(robot).map(|(_, moment, _)| moment).max()
    }

    /// The other robots within [`NEAR_M`] of `robot`, nearest first.
    pub(super) fn peers(&self, robot: RobotId) -> Vec<Peer> {
        let newest = self.peers_moment(robot).unwrap_or_default();
        let Some(&(_, me)) = self.robots.get(&robot) else { return Vec::new() };
        let recent =
            self.others(robot).filter(|(_, moment, _)| newest.since(*moment) <= POSE_STALE);
        let peers = recent.map(|(id, moment, pose)| {
            let Footprint { half_length, half_width } = self.footprint(id);
            let age = (newest.since(moment).micros() / 10_000).min(255) as u8;
            let peer = Peer { robot: id, pose, age, half_length, half_width };
            (distance_m(me, pose.x, pose.y), peer)
        });
        nearest_first(peers)
    }

    /// All known robots: time and pose of their last report, and footprint.
    pub(super) fn robots(&self) -> impl Iterator<Item = (RobotId, Instant, Pose, Footprint)> {
        self.robots.iter().map(|(&id, &(moment, pose))| {
            (id, moment, pose, self.footprints.get(&id).copied().unwrap_or_default())
        })
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
        let Some(&(_, me)) = self.robots.get(&robot) else { return Vec::new() };
        let obstacles = self.tracks.now().map(|track| {
            let told = obstacle(&track);
            (distance_m(me, told.0.x, told.0.y), told)
        });
        nearest_first(obstacles)
    }

    fn others(&self, robot: RobotId) -> impl Iterator<Item = (RobotId, Instant, Pose)> {
        let others = self.robots.iter().filter(move |(id, _)| **id != robot);
        others.map(|(&id, &(moment, pose))| (id, moment, pose))
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
