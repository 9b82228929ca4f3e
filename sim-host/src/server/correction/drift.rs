//! How far a robot's pose has drifted from the map while it was followed by what it saw itself.

use nalgebra::{Matrix3, Vector2, Vector3};
use ubimap_protocol::units::{Angle, Millimetres, Pose};

use super::odometry::{Variances, off};
use crate::mapping::{
    Match,
    submaps::{Measured, Motion},
};

/// How far off robots have drawn the map in blind ground: deviations in mm and rad (a degree).
const MAP: Variances = Variances::of(50.0, 0.0175);
/// Deviations that a view adds in which a robot is followed: in mm and rad (0.15 degrees).
const FOLLOWED: Variances = Variances::of(10.0, 0.002_6);
/// Squared Mahalanobis distance beyond which a match is wrong: one good one in a thousand.
const GATE: f64 = 16.27;
/// Part of the square of its own correction that is added to the covariance of a match: one that corrects a pose by more
/// than its deviation may be wrong, and must not make it sure.
const DOUBT: f64 = 0.5;

/// The drift of a robot's pose in the map: a Kalman filter over its error, which grows with the way and is corrected by
/// matches with what robots drew.
///
/// These walls were drawn by robots that had drifted themselves. If the robot's pose went to each match with them, its own
/// walls would bend wherever it saw another's; so a pose that is followed well goes there slowly.
#[derive(Debug)]
pub(super) struct Drift {
    /// Of x, y (mm) and heading (rad) in the map. A heading that goes wrong displaces the position on the way, so the
    /// three belong together.
    covariance: Matrix3<f64>,
}

impl Drift {
    /// A robot that was just seen.
    pub(super) fn none() -> Self {
        Self::of(Variances::of(20.0, 0.009))
    }

    /// A robot whose pose is as good as the map.
    pub(super) fn of_map() -> Self {
        Self::of(MAP)
    }

    fn of(variances: Variances) -> Self {
        Self { covariance: diagonal(variances) }
    }

    /// The robot has driven on by a way in the map (mm), and was followed by what it saw, or else has strayed by this
    /// much.
    pub(super) fn go(&mut self, way: Vector2<f64>, strayed: Option<Variances>) {
        let strayed = diagonal(strayed.unwrap_or(FOLLOWED));
        let here = Measured { motion: Motion::identity(), covariance: self.covariance };
        let step = Measured { motion: Motion::new(way, 0.0), covariance: strayed };
        self.covariance = here.then(&step).covariance;
    }

    /// The covariance of the robot's pose in the map, of x, y (mm) and heading (rad).
    pub(super) fn covariance(&self) -> Matrix3<f64> {
        self.covariance
    }

    /// Corrects a pose by a match with the map. `None` if the match contradicts it: either may be wrong.
    pub(super) fn correct(&mut self, pose: Pose, found: &Match) -> Option<Pose> {
        let off = Vector3::from(off(pose, found.pose));
        let seen = found.covariance + diagonal(MAP);
        let distance = off.dot(&((self.covariance + seen).try_inverse()? * off));
        if distance > GATE {
            return None;
        }
        let doubted = seen + DOUBT * off * off.transpose();
        let gain = self.covariance * (self.covariance + doubted).try_inverse()?;
        let left = Matrix3::identity() - gain;
        // Joseph's form stays symmetric and positive whatever is rounded.
        self.covariance =
            left * self.covariance * left.transpose() + gain * doubted * gain.transpose();
        let by = gain * off;
        Some(Pose {
            x: pose.x + Millimetres(by.x.round() as i32),
            y: pose.y + Millimetres(by.y.round() as i32),
            heading: pose.heading + Angle::from_radians(by.z),
        })
    }
}

fn diagonal(Variances { place, turn }: Variances) -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::new(place, place, turn))
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    fn found(x: f64, y: f64, degrees: f64) -> Match {
        let pose = Pose::from_metres(x, y, degrees.to_radians());
        let covariance = Matrix3::from_diagonal(&Vector3::new(400.0, 400.0, 1e-4));
        Match { pose, covariance }
    }

    /// A robot that has driven straight on for this many steps of 0.2 m, and saw its way.
    fn driven(steps: usize) -> Drift {
        let mut drift = Drift::none();
        (0..steps).for_each(|_| drift.go(Vector2::new(200.0, 0.0), None));
        drift
    }

    #[test]
    fn a_map_that_is_a_little_askew_pulls_a_pose_slowly() {
        let mut drift = Drift::none();
        let (mut off, mut offs) = (Pose::default(), Vec::new());
        for way in (0..30).map(|it| 0.6 * f64::from(it)) {
            drift.go(Vector2::new(600.0, 0.0), None);
            let at = Pose { x: off.x + Millimetres((1_000.0 * way) as i32), ..off };
            let pose = drift.correct(at, &found(way + 0.06, 0.0, 2.0)).unwrap();
            off = Pose { x: off.x + pose.x - at.x, heading: pose.heading, ..off };
            offs.push((off.x.0, off.heading.degrees()));
        }
        let (x, heading) = offs[0];
        assert!(x < 15 && heading < 0.6, "{offs:?}");
        let (x, heading) = offs[29];
        assert!(x > 50 && heading > 1.7, "{offs:?}");
    }

    /// Against the errors of robots that drive the same way, and err as much at random.
    #[test]
    fn the_covariance_is_that_of_robots_that_err_at_random() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut random = |variance: f64| {
            let it: f64 = StandardNormal.sample(&mut rng);
            variance.sqrt() * it
        };
        let strayed = Variances::of(20.0, 0.004);
        let ways = [(0.3, 0.0); 40].into_iter().chain([(0.05, 0.2); 8]).chain([(0.2, 0.0); 30]);
        let steps: Vec<Motion> =
            ways.map(|(way, turn)| Motion::new(Vector2::new(1_000.0 * way, 0.0), turn)).collect();
        let mut drift = Drift::none();
        let mut at = Motion::identity();
        for step in &steps {
            drift.go(at.rotation * step.translation.vector, Some(strayed));
            at *= step;
        }
        let Variances { place, turn } = strayed;
        let mut sum = Matrix3::zeros();
        let robots = 4_000;
        for _ in 0..robots {
            let mut err = |place: f64, turn: f64| {
                Motion::new(Vector2::new(random(place), random(place)), random(turn))
            };
            let mut pose = err(400.0, 0.009 * 0.009);
            for step in &steps {
                pose = pose * step * err(place, turn);
            }
            let by = pose.translation.vector - at.translation.vector;
            let turned = at.rotation.rotation_to(&pose.rotation).angle();
            let off = Vector3::new(by.x, by.y, turned);
            sum += off * off.transpose();
        }
        let sampled = sum / f64::from(robots);
        let scale =
            |it: &Matrix3<f64>, (row, column)| f64::sqrt(it[(row, row)] * it[(column, column)]);
        for at in [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)] {
            let off = (drift.covariance()[at] - sampled[at]) / scale(&sampled, at);
            assert!(off.abs() < 0.1, "{at:?}: {} {sampled}", drift.covariance());
        }
    }

    #[test]
    fn where_a_robot_has_got_to_tells_of_its_heading() {
        let mut drift = driven(100);
        let pose = Pose::from_metres(20.0, 0.0, 0.0);
        // Its heading is not known from this match, but a degree too small a heading would lead there.
        let covariance = Matrix3::from_diagonal(&Vector3::new(400.0, 400.0, 1.0));
        let found = Match { pose: Pose::from_metres(20.0, 0.175, 0.0), covariance };
        let corrected = drift.correct(pose, &found).unwrap();
        assert!(corrected.heading.degrees() > 0.4, "{corrected:?}");
    }

    #[test]
    fn a_match_is_believed_as_far_as_the_drift_explains_it() {
        let pose = Pose::from_metres(20.0, 0.0, 0.0);
        // 0.6 m to the side after 4 m, and after 20 m.
        assert_eq!(driven(20).correct(pose, &found(20.0, 0.6, 0.0)), None);
        let mut drift = driven(100);
        let aside = drift.correct(pose, &found(20.0, 0.6, 0.0)).unwrap();
        assert!((100..500).contains(&aside.y.0), "{aside:?}");
        // It is not sure of that: another place may still be the right one.
        let back = drift.correct(aside, &found(20.0, 0.0, 0.0)).unwrap();
        assert!(back.y.0 < aside.y.0 / 2, "{aside:?} {back:?}");
    }

    #[test]
    fn a_robot_that_has_strayed_follows_the_map() {
        let mut drift = Drift::none();
        drift.go(Vector2::zeros(), Some(Variances::of(300.0, 0.1)));
        let mut pose = Pose::default();
        for _ in 0..3 {
            pose = drift.correct(pose, &found(0.4, 0.0, 5.0)).unwrap();
        }
        assert!(pose.x.0 > 340 && pose.heading.degrees() > 4.0, "{pose:?}");
    }
}
