//! A robot's time in blind ground, where what it sees shows where it is.

use ubimap_protocol::{
    message::DistanceVector,
    time::Duration,
    units::{Angle, Millimetres, Pose, RobotId},
};

use crate::{
    mapping::{Match, Prior, Search, Surfaces, Trail},
    server::shared_map::SharedMap,
};

/// What a robot drew counts for its own fixes once it is this old, in seconds: what it has just
/// drawn can only agree with where it believes to be.
const OWN_AGE: u32 = 30;
/// How far a robot strays from its odometry after a metre or a radian, in millimetres and radians:
/// standard deviations, whose squares grow with the way.
const STRAYS: (f64, f64) = (20.0, 0.0175);
/// The longest way, in metres, that a robot is taken to have come, at 1 m/s, before it is first heard
/// of in blind ground.
const UNHEARD_M: f64 = 6.0;

/// A robot's time out of view.
#[derive(Debug)]
pub(super) struct BlindTrip {
    /// What it has seen since.
    trail: Trail,
    /// Where it believed to be last.
    last: Pose,
    /// How far it has come and turned since its pose was known.
    way_mm: f64,
    turned: f64,
}

impl BlindTrip {
    /// A robot that has been out of view for a time and believes to be here.
    pub(super) fn after(unseen: Duration, last: Pose) -> Self {
        let metres = (unseen.micros() as f64 / 1e6).min(UNHEARD_M);
        Self { trail: Trail::default(), last, way_mm: 1_000.0 * metres, turned: 0.0 }
    }

    /// It has just left the view and knows well where it is: what it sees from there is remembered.
    pub(super) fn remember(&mut self, pose: Pose, points: &[[f64; 2]], resolution: Millimetres) {
        self.trail.add(pose, points, resolution);
    }

    /// Where the robot must be to see what it sees.
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
            // What it has seen on its way is finer than what it drew, and goes before.
            if let Some(own) = own.filter(|_| !self.trail.has(id)) {
                tile.fill_unknown_from(&own.drawn_by(id, settled));
            }
            tile
        };
        let surfaces = Surfaces::about(vector.pose, reach, resolution, drawn, &self.trail);
        let found = surfaces.find(points, vector.pose, search);
        let pose = found.map_or(vector.pose, |found| found.pose);
        self.trail.add(pose, points, resolution);
        if found.is_some() {
            (self.way_mm, self.turned) = (0.0, 0.0);
        }
        found
    }

    /// It believes to be somewhere else now. Returns where to look for it.
    fn go(&mut self, to: Pose) -> Search {
        let (x, y) = (to.x - self.last.x, to.y - self.last.y);
        self.way_mm += f64::from(x.0).hypot(f64::from(y.0));
        self.turned += (to.heading - self.last.heading).radians().abs();
        self.last = to;
        let (way, turned) = (self.way_mm / 1_000.0, self.turned);
        // A robot that slips by 10 % and turns by 3 degrees on each metre is found again.
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

/// How far around a robot the map is looked at.
pub(super) fn reach(points: &[[f64; 2]], search: Search) -> Millimetres {
    let farthest = points.iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f64::max);
    Millimetres(farthest as i32 + search.position.0 + 300)
}
