//! Localises a robot in blind ground (out of the cameras' view) by its distance vectors.

use ubimap_protocol::{
    message::DistanceVector,
    time::Duration,
    units::{Angle, Millimetres, Pose, RobotId},
};

use crate::{
    mapping::{
        Match, Prior, Search, Surfaces, Trail,
        submaps::{Motion, motion},
    },
    server::{shared_map::SharedMap, surroundings::Place},
};

/// Minimum age in seconds of the robot's own cells that are used to localise it: newer cells were
/// drawn from the pose estimate that is to be checked.
const OWN_AGE: u32 = 30;
/// Odometry drift per square root of a metre or a radian: standard deviations in millimetres and
/// radians.
const STRAYS: (f64, f64) = (20.0, 0.0175);
/// Maximum distance in metres that a robot is assumed to have driven, at 1 m/s, before its first
/// report from blind ground.
const UNHEARD_M: f64 = 6.0;

/// Distance and angle (5 degrees) within which two views of a robot that has booted lead to one place.
const SAME: (Millimetres, Angle) = (Millimetres(150), Angle(910));

/// Two views from poses that differ by less than this distance and this angle (20 degrees) can be wrong in the same
/// way, and confirm nothing.
const ALIKE: (Millimetres, Angle) = (Millimetres(300), Angle(3_641));

/// The time that a robot spends out of the cameras' view.
#[derive(Debug)]
pub(super) struct BlindTrip {
    /// The surfaces that the robot has seen during the trip.
    trail: Trail,
    /// The pose that the robot last reported.
    last: Pose,
    /// Distance driven in millimetres, and angle turned in radians, since the robot's pose was last
    /// known from cameras or a match.
    way_mm: f64,
    turned: f64,
    /// `None` once the robot was found after it booted.
    booted: Option<Booted>,
}

/// A robot that has booted, and does not know where.
#[derive(Clone, Copy, Debug)]
struct Booted {
    /// Whether it stood when it was last heard of.
    stood: bool,
    /// The last pose found in any heading, and the one that the robot believed in then.
    last: Option<(Pose, Pose)>,
}

impl Booted {
    /// Finds the robot's pose about the place where it believes to be: there, if it stood and sees what is to
    /// be seen from there; otherwise in any heading, if two different views in a row lead to one place.
    fn find(&mut self, surfaces: &Surfaces, points: &[[f64; 2]], believed: Pose) -> Option<Match> {
        if let Some(found) =
            self.stood.then(|| surfaces.find_where_it_stood(points, believed)).flatten()
        {
            return Some(found);
        }
        let found = surfaces.find_in_any_heading(points, believed)?;
        let Some((seen, from)) = self.last else {
            self.last = Some((found.pose, believed));
            return None;
        };
        let is_within = |motion: &Motion, (way, turn): (Millimetres, Angle)| {
            motion.translation.vector.norm() <= way.metres()
                && motion.rotation.angle().abs() <= turn.radians()
        };
        let moved = motion(from).inverse() * motion(believed);
        if is_within(&moved, ALIKE) {
            return None;
        }
        self.last = Some((found.pose, believed));
        let off = (motion(seen) * moved).inverse() * motion(found.pose);
        is_within(&off, SAME).then_some(found)
    }
}

impl BlindTrip {
    /// Starts the trip of a robot whose reported pose is `last` and that has been out of view for
    /// `unseen`.
    pub(super) fn after(unseen: Duration, last: Pose) -> Self {
        let metres = (unseen.micros() as f64 / 1e6).min(UNHEARD_M);
        Self { trail: Trail::default(), last, way_mm: 1_000.0 * metres, turned: 0.0, booted: None }
    }

    /// Starts the trip of a robot that has booted somewhere about a place.
    pub(super) fn about(place: &Place) -> Self {
        let way_mm = 1_000.0 * UNHEARD_M;
        let booted = Some(Booted { stood: place.stands(), last: None });
        Self { booted, way_mm, ..Self::after(Duration::default(), place.pose) }
    }

    /// Whether the robot has booted and was not found yet.
    pub(super) fn is_sought(&self) -> bool {
        self.booted.is_some()
    }

    /// Adds points to the trail. Called while the robot has only just left the view, so that its
    /// pose is still accurate.
    pub(super) fn remember(&mut self, pose: Pose, points: &[[f64; 2]], resolution: Millimetres) {
        if self.booted.is_none() {
            self.trail.add(pose, points, resolution);
        }
    }

    /// Finds the pose from which the robot saw the points of a distance vector, and adds them to
    /// the trail. `None` without a unique match.
    pub(super) fn locate(
        &mut self,
        robot: RobotId,
        vector: &DistanceVector,
        points: &[[f64; 2]],
        (map, resolution): (&SharedMap, Millimetres),
    ) -> Option<Match> {
        let search = self.go(vector.pose);
        let settled = ((vector.time.micros() / 1_000_000) as u32).saturating_sub(OWN_AGE);
        let own = map.layer(robot);
        let reach = reach(points, search);
        let drawn = |id| {
            let mut tile = map.without(Some(robot), id);
            // The trail is finer than the robot's own cells, and replaces them.
            if let Some(own) = own.filter(|_| !self.trail.has(id)) {
                tile.fill_unknown_from(&own.drawn_by(id, settled));
            }
            tile
        };
        let surfaces = Surfaces::about(vector.pose, reach, resolution, drawn, &self.trail);
        let found = match &mut self.booted {
            Some(booted) => booted.find(&surfaces, points, vector.pose),
            None => surfaces.find(points, vector.pose, search),
        };
        if found.is_some() {
            (self.way_mm, self.turned, self.booted) = (0.0, 0.0, None);
        }
        // What is seen in an unknown heading would mislead the next search.
        if self.booted.is_none() {
            let pose = found.map_or(vector.pose, |found| found.pose);
            self.trail.add(pose, points, resolution);
        }
        found
    }

    /// Adds the motion since the last reported pose. Returns the search range around the new one.
    fn go(&mut self, to: Pose) -> Search {
        let (x, y) = (to.x - self.last.x, to.y - self.last.y);
        self.way_mm += f64::from(x.0).hypot(f64::from(y.0));
        self.turned += (to.heading - self.last.heading).radians().abs();
        self.last = to;
        let (way, turned) = (self.way_mm / 1_000.0, self.turned);
        // Sufficient for a robot that slips by 10 % and turns by 3 degrees per metre.
        Search {
            position: Millimetres((200.0 + 100.0 * way).min(800.0) as i32),
            turn: Angle((800.0 + 500.0 * way).min(4_000.0) as u16),
            prior: Prior::Carried(
                Millimetres((STRAYS.0 * way.sqrt()) as i32),
                Angle::from_radians((STRAYS.1 * (way + turned).sqrt()).min(1.0)),
            ),
        }
    }
}

/// Radius of the section of the map around a robot that a search needs.
pub(super) fn reach(points: &[[f64; 2]], search: Search) -> Millimetres {
    let farthest = points.iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f64::max);
    Millimetres(farthest as i32 + search.position.0 + 300)
}
