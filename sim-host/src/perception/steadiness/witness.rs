//! What the neighbours of a camera say about its pose: it sees a robot's marker where it should be by the
//! sightings of other cameras at that time, or not.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix3, Matrix6, Point3, Vector6};

use super::motion::{Motion, transform};
use crate::{
    camera::Calibration,
    perception::markers::{Marker, Placement},
};

/// Standard deviations of errors that don't average out: of a point in a picture, and of a robot's pose by
/// other cameras (their own calibration, and markers that are not quite level).
const POINT_PX: f64 = 0.3;
const PLACE_M: f64 = 0.004;
const HEADING_RAD: f64 = 0.01;
/// Step of the numerical derivatives, in metres and radians.
const STEP: f64 = 1e-5;

/// A marker in a picture of a camera, and the robot's pose by other cameras.
#[derive(Clone, Debug)]
pub struct Witness {
    /// The marker that the camera sees.
    pub marker: Marker,
    /// Its points in `base_link` and their height above the floor, in metres.
    pub points: Vec<[f64; 2]>,
    /// See `points`.
    pub height_m: f64,
    /// Where the robot is by the other cameras.
    pub place: Placement,
}

impl Witness {
    /// The motion of a camera since it had the pose in its `calibration`: the step of Gauss and Newton
    /// towards the pose from which the marker is seen where it is. `None` if it can't be in view.
    pub fn motion(&self, calibration: &Calibration) -> Option<Motion> {
        let [x, y] = self.place.position_m;
        let place = [x, y, self.place.heading_rad];
        let still = Vector6::zeros();
        let expected = self.pixels(calibration, &still, place)?;
        let seen = self.marker.points.iter().flatten().copied();
        let errors = DVector::from_iterator(expected.len(), seen) - &expected;
        let mut by_motion = DMatrix::zeros(expected.len(), 6);
        for axis in 0..6 {
            let mut step = still;
            step[axis] = STEP;
            let moved = self.pixels(calibration, &step, place)?;
            by_motion.set_column(axis, &((moved - &expected) / STEP));
        }
        let mut by_place = DMatrix::zeros(expected.len(), 3);
        for axis in 0..3 {
            let mut there = place;
            there[axis] += STEP;
            let moved = self.pixels(calibration, &still, there)?;
            by_place.set_column(axis, &((moved - &expected) / STEP));
        }
        let floor = [PLACE_M, PLACE_M, HEADING_RAD].map(|sigma| sigma * sigma);
        let place = self.place.covariance + Matrix3::from_diagonal(&floor.into());
        let noise = self.marker.noise_px * self.marker.noise_px + POINT_PX * POINT_PX;
        let covariance = &by_place * place * by_place.transpose()
            + DMatrix::identity(expected.len(), expected.len()) * noise;
        let weights = by_motion.transpose() * covariance.try_inverse()?;
        let information: Matrix6<f64> = (&weights * &by_motion).fixed_view::<6, 6>(0, 0).into();
        let weighted: Vector6<f64> = (&weights * errors).fixed_rows::<6>(0).into();
        let is_finite = weighted.iter().chain(information.iter()).all(|it| it.is_finite());
        is_finite.then(|| Motion::weighted(weighted, information))
    }

    /// The marker's points in the picture of a camera that has moved, by a robot at x, y and heading.
    fn pixels(
        &self,
        calibration: &Calibration,
        motion: &Vector6<f64>,
        [x, y, heading]: [f64; 3],
    ) -> Option<DVector<f64>> {
        let (camera, picture) = (calibration.pose()?, calibration.picture?);
        let sensor = camera.inv_mul(picture.pose());
        let moved: Isometry3<f64> = camera * transform(motion) * sensor;
        let (sine, cosine) = libm::sincos(heading);
        let pixel = |&[ahead, left]: &[f64; 2]| {
            let at = [x + cosine * ahead - sine * left, y + sine * ahead + cosine * left];
            let at = Point3::new(at[0], at[1], self.height_m);
            picture.intrinsics().project(&moved.inverse_transform_point(&at).coords)
        };
        let pixels: Vec<[f64; 2]> = self.points.iter().map(pixel).collect::<Option<_>>()?;
        let same = pixels.len() == self.marker.points.len();
        same.then(|| DVector::from_iterator(2 * pixels.len(), pixels.into_iter().flatten()))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Translation3;

    use super::*;
    use crate::{
        camera::{Intrinsics, Lens, Orientation},
        perception::markers::{Identifier, Mount},
    };
    use ubimap_protocol::units::RobotId;

    #[test]
    fn markers_tell_the_motion_of_a_camera() {
        let rotation = Orientation { tilt_rad: 1.2, heading_rad: 0.3, roll_rad: 0.0 }.rotation();
        let stated = Isometry3::from_parts(Translation3::new(1.0, 2.0, 2.8), rotation);
        let at = |pose: Isometry3<f64>| {
            let lens = |left: f64, pose: Isometry3<f64>| {
                let pose = pose * Translation3::new(-left, 0.0, 0.0);
                Lens::new(Intrinsics::pinhole(1280, 720, 1.2), pose).unwrap()
            };
            let (depth, picture) = (Some(lens(0.0, pose)), Some(lens(0.015, pose)));
            Calibration { depth, picture, ..Calibration::default() }
        };
        let truth = Vector6::new(0.02, -0.01, 0.005, 0.01, -0.005, 0.02);
        let (stated, real) = (at(stated), at(stated * transform(&truth)));
        let mount = Mount::centred(RobotId(1), 0.16, 0.3);
        let identifier = Identifier::Tag(1);
        let mut motion = Motion::UNKNOWN;
        for (x, y, heading) in
            [(1.2, 2.0, 0.1), (2.0, 1.5, 1.0), (1.8, 2.6, -2.0), (2.4, 2.3, 3.0), (1.3, 1.4, 0.5)]
        {
            let place = Placement {
                position_m: [x, y],
                heading_rad: heading,
                covariance: Matrix3::identity() * 1e-6,
            };
            let points = mount.points(identifier);
            let marker = Marker { identifier, points: Vec::new(), noise_px: 0.1 };
            let mut witness = Witness { marker, points, height_m: 0.3, place };
            witness.marker.points = vec![[0.0; 2]; 4];
            let seen = witness.pixels(&real, &Vector6::zeros(), [x, y, heading]).unwrap();
            witness.marker.points = seen.as_slice().chunks(2).map(|it| [it[0], it[1]]).collect();
            motion = motion.with(&witness.motion(&stated).unwrap().faded(100.0));
        }
        let (found, _) = motion.estimate().unwrap();
        assert!((found - truth).amax() < 0.002, "{found}");
    }
}
