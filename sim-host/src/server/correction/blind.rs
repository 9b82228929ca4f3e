//! Localises a robot in blind ground (out of the cameras' view) by its distance vectors.
//!
//! The robot is followed from view to view by its odometry and by the surfaces that it has seen on its trip: over
//! a second both are good, so that nothing has to be searched, and few points help. Its [`Drift`] from the map that all
//! robots draw is corrected by matches with that.

use ubimap_protocol::{
    message::DistanceVector,
    tile::Tile,
    time::Duration,
    units::{Angle, Millimetres, Pose, RobotId},
};

use super::{
    booted::Booted,
    drift::{Corrected, Drift},
    odometry::{Reported, TurnScale, Variances},
};
use crate::{
    mapping::{
        Match, Prior, Search, Surfaces, Trail,
        submaps::{self, Motion, View, motion},
        trajectories::{Step, Trajectories},
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
/// Search range in which a robot is followed, beyond three deviations of its odometry.
const BESIDE: (Millimetres, Angle) = (Millimetres(50), Angle(200));
/// Deviation of the motion over a view, beyond that of the odometry: of its rounding and of the view's time.
const VIEWED: Variances = Variances::of(5.0, 0.001);
/// By how much a robot's heading may drift per metre that it drives straight, in radians: as on wheels whose sizes
/// differ by 0.7 %, 0.23 m apart. Within a trip that is no noise, so it must not hold back what the robot sees.
const BENT: f64 = 0.03;
/// Deviation of a step of a robot's trajectory, beyond that of the odometry; it is generous, because
/// what the robot saw counts as well.
const STEPPED: Variances = Variances::of(20.0, 0.01);
/// Maximum deviation of a followed robot's heading, in radians, to learn from it.
const SURE: f64 = 0.02;
/// How far from the place where it is believed to be a robot that has booted is sought.
const SOUGHT: Millimetres = Millimetres(800);

/// The time that a robot spends out of the cameras' view.
#[derive(Debug)]
pub(super) struct BlindTrip {
    /// The surfaces that the robot has seen during the trip.
    trail: Trail,
    /// Where the robot was in its last view.
    at: Motion,
    reported: Reported,
    drift: Drift,
    /// Distance driven in millimetres, and angle turned in radians, since the robot's pose was last
    /// known from cameras or a match.
    way_mm: f64,
    turned: f64,
    /// `None` once the robot was found after it booted.
    booted: Option<Booted>,
    /// Whether no view was added yet.
    is_new: bool,
}

impl BlindTrip {
    /// Starts the trip of a robot whose reported pose is `last` and that has been out of view for
    /// `unseen`.
    pub(super) fn after(unseen: Duration, last: Pose) -> Self {
        let metres = (unseen.micros() as f64 / 1e6).min(UNHEARD_M);
        let mut drift = Drift::none();
        drift.go(Some(Variances::of_motion(&Motion::translation(metres, 0.0))));
        Self {
            trail: Trail::default(),
            at: motion(last),
            reported: Reported::seen_at(last),
            drift,
            way_mm: 1_000.0 * metres,
            turned: 0.0,
            booted: None,
            is_new: true,
        }
    }

    /// Starts the trip of a robot that has booted somewhere about a place.
    pub(super) fn about(place: &Place) -> Self {
        let booted = Some(Booted::new(place.stands()));
        Self { booted, ..Self::after(Duration::default(), place.pose) }
    }

    /// Whether the robot has booted and was not found yet.
    pub(super) fn is_sought(&self) -> bool {
        self.booted.is_some()
    }

    /// Adds points to the trail. Called while the robot has only just left the view, so that its
    /// pose is still accurate.
    pub(super) fn remember(&mut self, pose: Pose, points: &[[f64; 2]], resolution: Millimetres) {
        if self.booted.is_none() {
            self.is_new = false;
            (self.at, self.reported) = (motion(pose), Reported::seen_at(pose));
            self.trail.add(pose, points, resolution);
        }
    }

    /// Finds the pose from which the robot saw the points of a distance vector, and adds them to
    /// the trail. `None` if they do not determine it. `scale` is the robot's; it is learnt on the way.
    pub(super) fn locate(
        &mut self,
        robot: RobotId,
        vector: &DistanceVector,
        points: &[[f64; 2]],
        (map, resolution): (&SharedMap, Millimetres),
        scale: &mut TurnScale,
        mut trajectories: Option<&mut Trajectories>,
    ) -> Option<Match> {
        let settled = ((vector.time.micros() / 1_000_000) as u32).saturating_sub(OWN_AGE);
        let reach = reach(points);
        let drawn = |id| {
            let mut tile = map.without(Some(robot), id);
            if let Some(own) = map.drawn(robot, id) {
                tile.fill_unknown_from(&own.by(settled));
            }
            tile
        };
        // Without the trail, which has drifted as the robot has, and would agree with it.
        let surfaces =
            |pose, reach| Surfaces::about(pose, reach, resolution, drawn, &Trail::default());
        if let Some(booted) = &mut self.booted {
            let surfaces = surfaces(vector.pose, reach + SOUGHT);
            let found = booted.find(&surfaces, points, vector.pose)?;
            self.begin_at(&found);
            if let Some(trajectories) = trajectories {
                trajectories.found(robot, &View::of(vector), self.at);
            }
            self.trail.add(found.pose, points, resolution);
            return Some(found);
        }

        let rolled = self.reported.rolled_to(vector.pose);
        let near = |trail: &Trail, pose| {
            Surfaces::about(pose, reach, resolution, |_| Tile::UNKNOWN, trail)
        };
        let followed_from = self.at;
        let followed = self.follow(&rolled, points, near, scale);
        let by = followed_from.inv_mul(&self.at);
        let strayed = Variances::of_motion(&rolled);
        let strayed = strayed.plus(STEPPED);
        let seen =
            followed.map(|it| it.deviations()).map(|[x, y, turn]| [1e-3 * x, 1e-3 * y, turn]);
        let step = Step::new(by, [1e-3 * strayed.place.sqrt(), strayed.turn.sqrt()], seen);
        let mut pose = submaps::pose(&self.at);
        let search = self.go(&rolled);
        let found = surfaces(pose, reach + search.position).find(points, pose, search);
        if let Some(corrected) = found.and_then(|found| self.drift.correct(pose, &found)) {
            (self.way_mm, self.turned) = (0.0, 0.0);
            pose = corrected.pose();
            if let Corrected::Moved(_) = corrected {
                // What the robot has seen from wrong poses would draw it back.
                self.trail = Trail::default();
            }
        }
        self.at = motion(pose);
        if let Some(trajectories) = trajectories.as_mut() {
            let step = (!core::mem::take(&mut self.is_new)).then_some(step);
            trajectories.add(robot, &View::of(vector), self.at, step, None);
        }
        self.trail.add(pose, points, resolution);
        let sure = followed.filter(Match::is_sure).or(found);
        let fix = sure.map(|sure| Match { pose, ..sure })?;
        self.reported.fix(&fix);
        Some(fix)
    }

    /// Begins anew where the robot, which did not know its pose, was found.
    fn begin_at(&mut self, found: &Match) {
        (self.way_mm, self.turned, self.booted) = (0.0, 0.0, None);
        self.at = motion(found.pose);
        (self.reported, self.drift) = (Reported::found_by(found), Drift::of_map());
    }

    /// Moves on by what the odometry says, and then by what the robot sees of its trail's surfaces `near` the
    /// predicted pose. Returns the match with these.
    fn follow(
        &mut self,
        rolled: &Motion,
        points: &[[f64; 2]],
        near: impl Fn(&Trail, Pose) -> Surfaces,
        scale: &mut TurnScale,
    ) -> Option<Match> {
        let predicted = submaps::pose(&(self.at * scale.corrected(rolled)));
        let bent = Variances::of(0.0, BENT * rolled.translation.vector.norm());
        let strayed = Variances::of_motion(rolled).plus(VIEWED).plus(bent);
        let (place, turn) = strayed.deviations();
        let search = Search {
            position: Millimetres(3 * place.0) + BESIDE.0,
            turn: Angle(turn.0.saturating_mul(3)) + BESIDE.1,
            prior: Prior::Carried(place, turn),
        };
        let followed = near(&self.trail, predicted).follow(points, predicted, search);
        let pose = followed.map_or(predicted, |it| it.pose);
        self.at = motion(pose);
        match followed.map(|it| it.deviations()) {
            Some([.., seen]) if seen < SURE => {
                let off = (predicted.heading - pose.heading).radians();
                scale.learn(rolled.rotation.angle(), off, strayed.turn + seen * seen);
                self.drift.go(None);
            }
            _ => self.drift.go(Some(strayed)),
        }
        followed
    }

    /// Adds a motion. Returns the search range around the new pose.
    fn go(&mut self, rolled: &Motion) -> Search {
        self.way_mm += 1_000.0 * rolled.translation.vector.norm();
        self.turned += rolled.rotation.angle().abs();
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

/// Radius of the section of the map around a robot's place that its points need.
pub(super) fn reach(points: &[[f64; 2]]) -> Millimetres {
    let farthest = points.iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f64::max);
    Millimetres(farthest as i32 + 300)
}
