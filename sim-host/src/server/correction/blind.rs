//! Localises a robot in blind ground (out of the cameras' view) by its distance vectors.
//!
//! The robot is followed from view to view by its odometry and by the surfaces that it has seen on its trip: over
//! a second both are good, so that nothing has to be searched, and few points help. This gives its way in a frame of its
//! own, that of the trip, which drifts in the map. The [`Drift`] is corrected by matches with the map that all robots
//! draw, and by where their trajectories put the robot's views.

use nalgebra::Vector2;
use ubimap_protocol::{
    message::DistanceVector,
    tile::Tile,
    time::Duration,
    units::{Angle, Millimetres, Pose, RobotId},
};

use super::{
    booted::Booted,
    drift::Drift,
    odometry::{RateError, Reported, SystematicErrors, Variances},
};
use crate::{
    mapping::{
        Match, Prior, Search, Surfaces, Trail,
        submaps::{self, Motion, View, is_within, motion},
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
/// Maximum turn (rad) of a way that counts as straight, and maximum deviation (mm) of a match along it, to learn from it.
const STRAIGHT: f64 = 0.1;
const TOLD_MM: f64 = 22.0;
/// Deviation (mm) of what such a match corrects a way by: 7.4 mm in 1,719 matches on two floor plans.
const CORRECTED_MM: f64 = 8.0;
/// Part of the way that a robot's pose goes to where the trajectories put it, with each view: a wrong match among them, which
/// is taken back after some seconds, moves it little.
const SETTLING: f64 = 0.2;
/// Within this distance (m) and turn (11 degrees) of where a robot is believed to be, its pose follows what all robots'
/// trajectories say; farther off they are wrong more often than right.
const FAR: (f64, f64) = (0.5, 0.2);
/// How far from the place where it is believed to be a robot that has booted is sought.
const SOUGHT: Millimetres = Millimetres(800);

/// The time that a robot spends out of the cameras' view.
#[derive(Debug)]
pub(super) struct BlindTrip {
    /// The surfaces that the robot has seen during the trip, in the trip's frame.
    trail: Trail,
    /// Where the robot was in its last view, in the trip's frame.
    at: Motion,
    /// The trip's frame in the map.
    frame: Motion,
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
    /// Starts the trip of a robot that reports this and has been out of view for `unseen`.
    pub(super) fn after(unseen: Duration, reported: Reported) -> Self {
        let metres = (unseen.micros() as f64 / 1e6).min(UNHEARD_M);
        let mut drift = Drift::none();
        let way = motion(reported.pose).rotation * Vector2::new(1_000.0 * metres, 0.0);
        drift.go(way, Some(Variances::of_motion(&Motion::translation(metres, 0.0))));
        Self {
            trail: Trail::default(),
            at: motion(reported.pose),
            frame: Motion::identity(),
            reported,
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
        Self { booted, ..Self::after(Duration::default(), Reported::at(place.pose)) }
    }

    /// Whether the robot has booted and was not found yet.
    pub(super) fn is_sought(&self) -> bool {
        self.booted.is_some()
    }

    /// Adds points to the trail. Called while the robot has only just left the view, so that its
    /// pose is still accurate.
    pub(super) fn remember(
        &mut self,
        vector: &DistanceVector,
        points: &[[f64; 2]],
        resolution: Millimetres,
    ) {
        if self.booted.is_none() {
            self.is_new = false;
            (self.at, self.reported) = (motion(vector.pose), Reported::by(vector));
            self.trail.add(vector.pose, points, resolution);
        }
    }

    /// Finds the pose from which the robot saw the points of a distance vector, and adds them to
    /// the trail. `None` if the robot has booted, and they do not tell where. `systematic` are the
    /// errors of the robot's odometry; they are learnt on the way.
    pub(super) fn locate(
        &mut self,
        robot: RobotId,
        vector: &DistanceVector,
        points: &[[f64; 2]],
        (map, resolution): (&SharedMap, Millimetres),
        systematic: &mut SystematicErrors,
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
            self.begin_at(&found, vector);
            if let Some(trajectories) = trajectories {
                trajectories.found(robot, &View::of(vector), self.at);
            }
            self.trail.add(found.pose, points, resolution);
            return Some(found);
        }

        let reported = Reported::by(vector);
        let rolled = self.reported.rolled_to(&reported);
        let near = |trail: &Trail, pose| {
            Surfaces::about(pose, reach, resolution, |_| Tile::UNKNOWN, trail)
        };
        self.settle(trajectories.as_ref().and_then(|it| it.newest(robot)));
        let followed_from = self.at;
        let followed = self.follow(&rolled, points, near, systematic);
        let by = followed_from.inv_mul(&self.at);
        self.trail.add(submaps::pose(&self.at), points, resolution);
        let strayed = Variances::of_motion(&rolled);
        let strayed = strayed.plus(STEPPED);
        let seen =
            followed.map(|it| it.deviations()).map(|[x, y, turn]| [1e-3 * x, 1e-3 * y, turn]);
        let step = Step::new(by, [1e-3 * strayed.place.sqrt(), strayed.turn.sqrt()], seen);
        let mut pose = submaps::pose(&(self.frame * self.at));
        let search = self.go(&rolled);
        let found = surfaces(pose, reach + search.position).find(points, pose, search);
        let corrected = found.and_then(|found| self.drift.correct(pose, &found));
        if let Some(corrected) = corrected {
            (self.way_mm, self.turned) = (0.0, 0.0);
            pose = corrected;
            self.frame = motion(pose) * self.at.inverse();
        }
        if let Some(trajectories) = trajectories.as_mut() {
            let (view, pose) = (View::of(vector), motion(pose));
            let step = (!self.is_new).then_some(step);
            trajectories.add(robot, &view, pose, step, None);
            if let Some(found) = found.filter(|_| corrected.is_some()) {
                trajectories.suggest(robot, motion(found.pose));
            }
        }
        self.is_new = false;
        let sure = followed.filter(Match::is_sure).map(|it| it.moved(&self.frame)).or(found);
        // Without a view, the server still knows better than the robot what its odometry is worth.
        let covariance = sure.map_or_else(|| self.drift.covariance(), |it| it.covariance);
        let fix = Match { pose, covariance };
        self.reported = reported.found(&fix);
        Some(fix)
    }

    /// Goes a part of the way to where all robots' trajectories put the last view.
    fn settle(&mut self, settled: Option<Motion>) {
        let held = self.frame * self.at;
        let Some(settled) = settled.filter(|it| !self.is_new && is_within(&it.inv_mul(&held), FAR))
        else {
            return;
        };
        let off = settled.translation.vector - held.translation.vector;
        let turn = held.rotation.rotation_to(&settled.rotation).angle();
        let pose = Motion::new(
            held.translation.vector + SETTLING * off,
            held.rotation.angle() + SETTLING * turn,
        );
        self.frame = pose * self.at.inverse();
    }

    /// Begins anew where the robot, which did not know its pose, was found.
    fn begin_at(&mut self, found: &Match, vector: &DistanceVector) {
        (self.way_mm, self.turned, self.booted, self.is_new) = (0.0, 0.0, None, false);
        (self.at, self.frame) = (motion(found.pose), Motion::identity());
        (self.reported, self.drift) = (Reported::by(vector).found(found), Drift::of_map());
    }

    /// Moves on by what the odometry says, and then by what the robot sees of its trail's surfaces `near` the
    /// predicted pose. Returns the match with these.
    fn follow(
        &mut self,
        rolled: &Motion,
        points: &[[f64; 2]],
        near: impl Fn(&Trail, Pose) -> Surfaces,
        systematic: &mut SystematicErrors,
    ) -> Option<Match> {
        let predicted = submaps::pose(&(self.at * systematic.corrected(rolled)));
        let bent = Variances::of(0.0, BENT * rolled.translation.vector.norm());
        let by_chance = Variances::of_motion(rolled).plus(VIEWED);
        let strayed = by_chance.plus(bent);
        let (place, turn) = strayed.deviations();
        let search = Search {
            position: Millimetres(3 * place.0) + BESIDE.0,
            turn: Angle(turn.0.saturating_mul(3)) + BESIDE.1,
            prior: Prior::Carried(place, turn),
        };
        let followed = near(&self.trail, predicted).follow(points, predicted, search);
        // A match that contradicts the odometry by more than it can err is wrong. It contains what the odometry says.
        let followed = followed.filter(|it| strayed.allow(predicted, it.pose));
        let pose = followed.map_or(predicted, |it| it.pose);
        if let Some(found) = &followed {
            learn_way(&mut systematic.ways, rolled, predicted, found);
        }
        let from = core::mem::replace(&mut self.at, motion(pose));
        let way = self.at.translation.vector - from.translation.vector;
        let way = self.frame.rotation * (1_000.0 * way);
        match followed.map(|it| it.deviations()) {
            Some([.., seen]) if seen < SURE => {
                let off = (predicted.heading - pose.heading).radians();
                systematic.learn_turn(rolled, off, by_chance.turn + seen * seen);
                self.drift.go(way, None);
            }
            _ => self.drift.go(way, Some(strayed)),
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

/// Learns from a way straight ahead towards surfaces that tell how long it was.
fn learn_way(scale: &mut RateError, rolled: &Motion, predicted: Pose, found: &Match) {
    let ahead = motion(predicted).rotation * Vector2::x();
    let place = found.covariance.fixed_view::<2, 2>(0, 0);
    let is_told = ahead.dot(&(place * ahead)) <= TOLD_MM * TOLD_MM;
    if is_told && rolled.rotation.angle().abs() <= STRAIGHT {
        let off = Vector2::new(predicted.x - found.pose.x, predicted.y - found.pose.y);
        let off_mm = ahead.dot(&off.map(|it| f64::from(it.0)));
        scale.learn(1e3 * rolled.translation.vector.x, off_mm, CORRECTED_MM * CORRECTED_MM);
    }
}

/// Radius of the section of the map around a robot's place that its points need.
pub(super) fn reach(points: &[[f64; 2]]) -> Millimetres {
    let farthest = points.iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f64::max);
    Millimetres(farthest as i32 + 300)
}

#[cfg(test)]
mod tests {
    use ubimap_protocol::time::Instant;

    use super::*;

    #[test]
    fn a_robot_goes_little_by_little_to_where_the_trajectories_put_it_unless_that_is_far() {
        let at = |x: f64, degrees: f64| Pose::from_metres(x, 2.0, degrees.to_radians());
        let vector = DistanceVector {
            time: Instant(0),
            pose: at(1.0, 179.0),
            first: Angle(0),
            step: 1,
            distances: [].into_iter().collect(),
            odometry: None,
        };
        let mut trip = BlindTrip::after(Duration::default(), Reported::by(&vector));
        let held = |trip: &BlindTrip| submaps::pose(&(trip.frame * trip.at));
        trip.settle(Some(motion(at(1.2, 179.0))));
        assert_eq!(held(&trip), vector.pose, "the trajectories do not have this trip yet");
        trip.remember(&vector, &[], Millimetres(50));
        for far in [at(1.6, 179.0), at(1.0, -168.0)] {
            trip.settle(Some(motion(far)));
            assert_eq!(held(&trip), vector.pose);
        }
        trip.settle(None);
        trip.settle(Some(motion(at(1.2, -176.0))));
        let first = held(&trip);
        assert!(
            (first.x.0 - 1_040).abs() <= 1 && first.heading.distance(at(0.0, 180.0).heading) <= 2
        );
        (0..20).for_each(|_| trip.settle(Some(motion(at(1.2, -176.0)))));
        let last = held(&trip);
        assert!(
            (last.x.0 - 1_200).abs() <= 3 && last.heading.distance(at(0.0, -176.0).heading) <= 10
        );
        assert_eq!(submaps::pose(&trip.at), vector.pose, "its own way is as it was");
    }

    #[test]
    fn the_scale_of_ways_is_learnt_from_straight_ones_that_the_surfaces_tell() {
        // The odometry reports 40 cm for every 39.6 cm driven. `along` and `across` are the deviations of the match in mm.
        let scale = |degrees: f64, turn: f64, along: f64, across: f64| {
            let mut systematic = SystematicErrors::default();
            let (from, by) = (motion(Pose::from_metres(1.0, 2.0, degrees.to_radians())), 0.4);
            let turned = submaps::turned(from.rotation.angle());
            let known = nalgebra::Vector3::new(along * along, across * across, 1e-4);
            let covariance = turned * nalgebra::Matrix3::from_diagonal(&known) * turned.transpose();
            for _ in 0..200 {
                let rolled = Motion::new(Vector2::new(by, 0.0), turn);
                let predicted = submaps::pose(&(from * systematic.corrected(&rolled)));
                let found =
                    submaps::pose(&(from * Motion::new(Vector2::new(0.99 * by, 0.0), turn)));
                learn_way(
                    &mut systematic.ways,
                    &rolled,
                    predicted,
                    &Match { pose: found, covariance },
                );
            }
            1.0 - systematic.corrected(&Motion::translation(1.0, 0.0)).translation.x
        };
        for degrees in [0.0, 90.0, 200.0] {
            let told = scale(degrees, 0.02, 15.0, 400.0);
            assert!((told - 0.01).abs() < 0.003, "{told}");
            assert_eq!(scale(degrees, 0.02, 400.0, 15.0), 0.0, "along a corridor");
            assert_eq!(scale(degrees, 0.5, 15.0, 15.0), 0.0, "in a turn");
        }
    }
}
