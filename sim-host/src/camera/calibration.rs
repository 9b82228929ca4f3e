//! The calibration of a fixed camera: the intrinsics and pose of each sensor, and its depth noise.

use nalgebra::{Isometry3, Point3, Vector3};

use super::{depth_noise::DepthNoise, error::CalibrationError};

/// The intrinsics of a sensor: a pinhole camera with radial and tangential distortion. The centre
/// of the first pixel is at (0, 0).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Width of the image in pixels.
    pub width: u32,
    /// Height of the image in pixels.
    pub height: u32,
    /// Horizontal focal length in pixels.
    pub fx: f64,
    /// Vertical focal length in pixels.
    pub fy: f64,
    /// Column of the principal point.
    pub cx: f64,
    /// Row of the principal point.
    pub cy: f64,
    /// Distortion coefficients k1, k2, p1, p2, k3.
    pub distortion: [f64; 5],
}

/// A sensor of a camera: its intrinsics and its pose in `map`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    intrinsics: Intrinsics,
    pose: Isometry3<f64>,
}

/// A fixed camera: a depth sensor, a colour or grey one, or both.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Calibration {
    /// The depth sensor.
    pub depth: Option<Lens>,
    /// The noise of the depth sensor.
    pub depth_noise: DepthNoise,
    /// The colour or grey sensor.
    pub picture: Option<Lens>,
}

/// Number of iterations of the fixed-point inversion of the distortion.
const STEPS: usize = 20;

impl Intrinsics {
    /// A pinhole without distortion whose principal point is the image centre, from its horizontal field
    /// of view in radians.
    pub fn pinhole(width: u32, height: u32, horizontal_fov_rad: f64) -> Self {
        let focal = f64::from(width) / 2.0 / libm::tan(horizontal_fov_rad / 2.0);
        Self {
            width,
            height,
            fx: focal,
            fy: focal,
            cx: (f64::from(width) - 1.0) / 2.0,
            cy: (f64::from(height) - 1.0) / 2.0,
            distortion: [0.0; 5],
        }
    }

    /// The pixel (column, row) onto which a direction in the optical frame projects; `None` if it points
    /// backwards. The pixel may be outside the image.
    pub fn project(&self, direction: &Vector3<f64>) -> Option<[f64; 2]> {
        if direction.z <= 0.0 {
            return None;
        }
        let [x, y] = self.distorted([direction.x / direction.z, direction.y / direction.z]);
        Some([self.fx * x + self.cx, self.fy * y + self.cy])
    }

    /// The ray of a pixel (column, row) in the optical frame, with z = 1: multiply it by a depth to get
    /// the point.
    pub fn direction(&self, [column, row]: [f64; 2]) -> Vector3<f64> {
        let aim = [(column - self.cx) / self.fx, (row - self.cy) / self.fy];
        let mut at = aim;
        if self.distortion != [0.0; 5] {
            for _ in 0..STEPS {
                let there = self.distorted(at);
                at = [at[0] + aim[0] - there[0], at[1] + aim[1] - there[1]];
            }
        }
        Vector3::new(at[0], at[1], 1.0)
    }

    /// Brown's distortion model, in OpenCV's form.
    fn distorted(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    fn check(&self) -> Result<(), CalibrationError> {
        let Self { width, height, fx, fy, cx, cy, distortion } = *self;
        if !(1..=16_384).contains(&width) || !(1..=16_384).contains(&height) {
            return Err(CalibrationError::Size(width, height));
        }
        if !(fx > 0.0 && fy > 0.0 && fx.is_finite() && fy.is_finite()) {
            return Err(CalibrationError::Focal(fx, fy));
        }
        let near = |at: f64, size: u32| (at / f64::from(size) - 0.5).abs() <= 1.5;
        if !near(cx, width) || !near(cy, height) {
            return Err(CalibrationError::Axis(cx, cy));
        }
        // The ray of a pixel must project back onto the pixel; strong distortions fail in the
        // corners first.
        let unfolds = |[column, row]: [f64; 2]| {
            let back = self.project(&self.direction([column, row]));
            back.is_some_and(|[c, r]| (c - column).abs() < 0.01 && (r - row).abs() < 0.01)
        };
        let (right, bottom) = (f64::from(width) - 1.0, f64::from(height) - 1.0);
        let corners = [[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]];
        if !distortion.iter().all(|it| it.is_finite()) || !corners.into_iter().all(unfolds) {
            return Err(CalibrationError::Distortion);
        }
        Ok(())
    }
}

impl Lens {
    /// A sensor whose optical frame (x right, y down, z forward) has this pose in `map`, in metres.
    ///
    /// # Errors
    /// Every [`CalibrationError`].
    pub fn new(intrinsics: Intrinsics, pose: Isometry3<f64>) -> Result<Self, CalibrationError> {
        intrinsics.check()?;
        let finite = pose.translation.vector.iter().chain(pose.rotation.coords.iter());
        if !finite.into_iter().all(|it| it.is_finite()) {
            return Err(CalibrationError::Pose);
        }
        Ok(Self { intrinsics, pose })
    }

    /// The intrinsics.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// The pose of the optical frame in `map`, in metres.
    pub fn pose(&self) -> &Isometry3<f64> {
        &self.pose
    }

    /// The optical centre in `map`, in metres.
    pub fn centre(&self) -> Point3<f64> {
        self.pose.translation.vector.into()
    }

    /// The pixel (column, row) that sees a point of `map`; `None` if the point is behind the camera. The
    /// pixel may be outside the image.
    pub fn project(&self, point: &Point3<f64>) -> Option<[f64; 2]> {
        self.intrinsics.project(&self.pose.inverse_transform_point(point).coords)
    }

    /// The ray of a pixel in `map`, for a depth of one metre: the point seen is the optical centre
    /// plus the depth times this vector.
    pub fn direction(&self, pixel: [f64; 2]) -> Vector3<f64> {
        self.pose.rotation * self.intrinsics.direction(pixel)
    }
}

impl Calibration {
    /// The pose of the camera in `map`, in metres: that of its depth sensor or, without one, of its
    /// picture sensor.
    pub fn pose(&self) -> Option<&Isometry3<f64>> {
        self.depth.as_ref().or(self.picture.as_ref()).map(Lens::pose)
    }

    /// The same camera at another pose; its sensors keep their poses relative to each other.
    ///
    /// # Errors
    /// [`CalibrationError::Pose`] if the pose is not finite.
    pub fn at(&self, pose: Isometry3<f64>) -> Result<Self, CalibrationError> {
        let Some(old) = self.pose() else { return Ok(*self) };
        let moved = |lens: Option<Lens>| {
            let lens = lens.map(|lens| Lens::new(lens.intrinsics, pose * old.inv_mul(&lens.pose)));
            lens.transpose()
        };
        Ok(Self { depth: moved(self.depth)?, picture: moved(self.picture)?, ..*self })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Rotation3, UnitQuaternion};

    fn kinect() -> Intrinsics {
        Intrinsics {
            distortion: [0.262_383, -0.953_104, -0.005_358, 0.002_628, 1.163_314],
            ..Intrinsics::pinhole(640, 480, 1.1)
        }
    }

    #[test]
    fn projecting_a_pixels_direction_gives_the_pixel() {
        let under_the_ceiling = Isometry3::from_parts(
            nalgebra::Translation3::new(1.0, -2.0, 2.8),
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_euler_angles(-2.5, 0.1, 0.7)),
        );
        let lens = Lens::new(kinect(), under_the_ceiling).unwrap();
        for pixel in [[0.0, 0.0], [639.0, 479.0], [12.5, 400.25], [319.5, 239.5]] {
            let point = lens.centre() + lens.direction(pixel) * 2.345;
            let [column, row] = lens.project(&point).unwrap();
            assert!((column - pixel[0]).abs() < 1e-3 && (row - pixel[1]).abs() < 1e-3);
            assert!((under_the_ceiling.inverse_transform_point(&point).z - 2.345).abs() < 1e-9);
        }
    }

    #[test]
    fn impossible_calibrations_are_refused() {
        let of = |change: fn(&mut Intrinsics)| {
            let mut intrinsics = kinect();
            change(&mut intrinsics);
            Lens::new(intrinsics, Isometry3::identity())
        };
        assert!(of(|_| {}).is_ok());
        assert_eq!(of(|it| it.width = 0), Err(CalibrationError::Size(0, 480)));
        assert!(matches!(of(|it| it.fy = -480.0), Err(CalibrationError::Focal(..))));
        assert!(matches!(of(|it| it.cx = f64::NAN), Err(CalibrationError::Axis(..))));
        assert_eq!(of(|it| it.distortion[1] = -9.0), Err(CalibrationError::Distortion));
        let nowhere = Isometry3::translation(0.0, f64::INFINITY, 0.0);
        assert_eq!(Lens::new(kinect(), nowhere), Err(CalibrationError::Pose));
    }
}
