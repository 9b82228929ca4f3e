//! How far a robot's pose has drifted from the map while it was followed by what it saw itself.

use nalgebra::{Matrix3, Vector3};
use ubimap_protocol::units::Pose;

use super::odometry::Variances;
use crate::mapping::{
    Match,
    submaps::{Motion, is_within, motion},
};

/// How far off robots have drawn the map in blind ground: deviations in mm and rad (a degree).
const MAP: (f64, f64) = (50.0, 0.0175);
/// Deviations that a view adds in which a robot is followed: in mm and rad (0.15 degrees).
const FOLLOWED: Variances = Variances::of(10.0, 0.002_6);
/// Distance (m) and angle (5 degrees) within which two corrections are the same.
const SAME: (f64, f64) = (0.15, 0.087);
/// From a place this far away (m), or turned by so much (40 degrees), a robot sees something else.
const ELSEWHERE: (f64, f64) = (0.5, 0.7);

/// Within this distance (m) and turn (11 degrees) of where a robot is believed to be, its pose follows what all robots'
/// trajectories say; farther off they are wrong more often than right.
pub(super) const FAR: (f64, f64) = (0.5, 0.2);

/// The drift of a robot's pose in the map.
///
/// Walls in blind ground were drawn by robots that had drifted themselves. If the robot's pose went to each match
/// with them, its own walls would bend wherever it saw another's. So matches pull a pose that is followed, and move it
/// only if two views of different walls agree that it is wrong, and the correction is within three deviations of its drift.
#[derive(Debug)]
pub(super) struct Drift {
    variances: Variances,
    /// A match that contradicted the pose: where the robot was, and the motion in the map that would correct it.
    contradiction: Option<(Pose, Motion)>,
}

/// What a match says of a robot's pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Corrected {
    /// It is a little off; the corrected pose.
    Pulled(Pose),
    /// It was wrong; the right one.
    Moved(Pose),
}

impl Corrected {
    pub(super) fn pose(self) -> Pose {
        let (Self::Pulled(pose) | Self::Moved(pose)) = self;
        pose
    }
}

impl Drift {
    /// A robot that was just seen.
    pub(super) fn none() -> Self {
        Self { variances: Variances::of(20.0, 0.009), contradiction: None }
    }

    /// A robot whose pose is as good as the map.
    pub(super) fn of_map() -> Self {
        Self { variances: Variances::of(MAP.0, MAP.1), contradiction: None }
    }

    /// The robot has driven on, and was followed by what it saw, or else has strayed by this much.
    pub(super) fn go(&mut self, strayed: Option<Variances>) {
        self.variances = self.variances.plus(strayed.unwrap_or(FOLLOWED));
    }

    /// The covariance of the robot's pose in the map, of x, y (mm) and heading (rad), `way` mm after it was last known.
    pub(super) fn covariance(&self, way: f64) -> Matrix3<f64> {
        let (place, turn) = (self.place(way), self.variances.turn);
        Matrix3::from_diagonal(&Vector3::new(place, place, turn))
    }

    /// The variance of its position, in mm^2: the heading went wrong little by little on the way, and the position with
    /// it.
    fn place(&self, way: f64) -> f64 {
        let Variances { place, turn } = self.variances;
        place + turn * way * way / 3.0
    }

    /// Corrects a pose by a match with the map, `way` mm after the pose was last known. `None` if the match contradicts
    /// it: either may be wrong.
    pub(super) fn correct(&mut self, pose: Pose, found: &Match, way: f64) -> Option<Corrected> {
        let [x, y, turn] = found.deviations();
        let deviations = [x.hypot(MAP.0), y.hypot(MAP.0), turn.hypot(MAP.1)];
        if let Some(pulled) = self.variances.correct(pose, found.pose, deviations) {
            self.contradiction = None;
            return Some(Corrected::Pulled(pulled));
        }
        // Another robot may have drawn this as far off, so the trajectories decide. Beyond that the robot may be lost, if
        // its drift explains the distance.
        let is_near = is_within(&motion(found.pose).inv_mul(&motion(pose)), FAR);
        let place = self.place(way);
        let drifted = Variances { place, ..self.variances };
        if is_near || !drifted.allow(pose, found.pose, deviations) {
            self.contradiction = None;
            return None;
        }
        let by = motion(found.pose) * motion(pose).inverse();
        if let Some((from, before)) = self.contradiction {
            let off = (before * motion(pose)).inverse() * motion(found.pose);
            let driven = motion(from).inverse() * motion(pose);
            match (is_within(&off, SAME), is_within(&driven, ELSEWHERE)) {
                (true, false) => {
                    *self = Self::of_map();
                    return Some(Corrected::Moved(found.pose));
                }
                (true, true) => return None,
                (false, _) => {}
            }
        }
        self.contradiction = Some((pose, by));
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(x: f64, y: f64, degrees: f64) -> Match {
        let pose = Pose::from_metres(x, y, degrees.to_radians());
        let covariance = Matrix3::from_diagonal(&Vector3::new(400.0, 400.0, 1e-4));
        Match { pose, covariance }
    }

    #[test]
    fn a_map_that_is_a_little_askew_pulls_a_pose_slowly() {
        let mut drift = Drift::none();
        let mut pose = Pose::default();
        let mut offs = Vec::new();
        for _ in 0..30 {
            drift.go(None);
            let Some(Corrected::Pulled(pulled)) = drift.correct(pose, &found(0.06, 0.0, 2.0), 0.0)
            else {
                panic!("{offs:?}")
            };
            pose = pulled;
            offs.push((pose.x.0, pose.heading.degrees()));
        }
        let (x, heading) = offs[0];
        assert!(x < 15 && heading < 0.6, "{offs:?}");
        let (x, heading) = offs[29];
        assert!(x > 50 && heading > 1.7, "{offs:?}");
    }

    #[test]
    fn a_pose_moves_only_if_views_from_two_places_agree() {
        let after = |drift: &mut Drift, x: f64, by: f64, way: f64| {
            drift.correct(Pose::from_metres(x, 0.0, 0.0), &found(x + by, 0.0, 0.0), way)
        };
        let mut drift = Drift::none();
        for x in [1.0, 2.0, 3.0] {
            assert_eq!(after(&mut drift, x, 0.6, 10_000.0), None, "it can't have drifted so far");
        }
        let far = |drift: &mut Drift, x: f64, by: f64| after(drift, x, by, 40_000.0);
        for x in [1.0, 2.0, 3.0] {
            assert_eq!(far(&mut drift, x, 0.45), None, "the trajectories know better");
        }
        assert_eq!(far(&mut drift, 1.0, 0.6), None);
        assert_eq!(far(&mut drift, 1.2, 0.6), None, "nearly the same view");
        assert_eq!(far(&mut drift, 2.0, -0.6), None, "another correction");
        assert_eq!(far(&mut drift, 2.6, 0.6), None);
        assert_eq!(far(&mut drift, 3.2, 0.4), None, "another one again, and near");
        assert_eq!(far(&mut drift, 3.8, 0.6), None);
        let there = Pose::from_metres(5.0, 0.0, 0.0);
        assert_eq!(far(&mut drift, 4.4, 0.6), Some(Corrected::Moved(there)));
        // It is as unsure as the map now.
        assert!(matches!(far(&mut drift, 4.4, 0.1), Some(Corrected::Pulled(_))));
    }

    #[test]
    fn a_heading_that_goes_wrong_on_the_way_displaces_the_position() {
        let mut drift = Drift::none();
        let step = Variances::of(20.0, 0.004);
        (0..100).for_each(|_| drift.go(Some(step)));
        // 100 steps of 0.2 m, by an integral of what each turn does to the rest of the way.
        let integral: f64 = (0..100).map(|it| (0.004 * 200.0 * f64::from(it)).powi(2)).sum();
        let [still, driven] = [0.0, 20_000.0].map(|way| drift.covariance(way)[(1, 1)]);
        assert!(((driven - still) / integral - 1.0).abs() < 0.1, "{still} {driven} {integral}");
    }

    #[test]
    fn a_robot_that_has_strayed_follows_the_map() {
        let mut drift = Drift::none();
        drift.go(Some(Variances::of(300.0, 0.1)));
        let Some(Corrected::Pulled(pose)) =
            drift.correct(Pose::default(), &found(0.4, 0.0, 5.0), 0.0)
        else {
            panic!()
        };
        assert!(pose.x.0 > 360 && pose.heading.degrees() > 4.5, "{pose:?}");
    }
}
