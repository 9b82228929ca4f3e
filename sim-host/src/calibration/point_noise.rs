//! The noise of a landmark's measured position.

use nalgebra::{Matrix3, Point3};

use crate::camera::DepthNoise;

/// The standard deviations of a measured point: along its ray and across it.
///
/// An error of the depth moves a point along its ray, and an error of the pixel moves it across. A
/// ceiling camera's depth is ten times worse than its pixels, so that two cameras that see a
/// landmark from different sides complement each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointNoise {
    lateral_m: f64,
    depth: DepthNoise,
}

/// The standard deviation across the ray, in metres, is impossible.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("lateral noise of {0} m; give a standard deviation from 0 to 1 m")]
pub struct LateralNoiseError(f64);

/// Minimum standard deviation: no landmark gets an infinite weight.
const LEAST_SIGMA_M: f64 = 1e-6;

impl PointNoise {
    /// One frame of an Intel RealSense D435. Across the ray 4 mm, a pixel at 1.4 m.
    pub const D435: Self = Self { lateral_m: 0.004, depth: DepthNoise::D435 };

    /// Noise with this standard deviation across the ray, in metres, and with the noise of the depth
    /// along it.
    ///
    /// # Errors
    /// [`LateralNoiseError`] if `lateral_m` is negative, above 1 m, or not finite.
    pub fn new(lateral_m: f64, depth: DepthNoise) -> Result<Self, LateralNoiseError> {
        if (0.0..=1.0).contains(&lateral_m) {
            Ok(Self { lateral_m, depth })
        } else {
            Err(LateralNoiseError(lateral_m))
        }
    }

    /// The noise of a mean over several frames whose errors are independent.
    pub fn averaged(self, frames: u32) -> Self {
        let factor = 1.0 / f64::from(frames.max(1)).sqrt();
        let [constant_m, quadratic_per_m] =
            [self.depth.constant_m(), self.depth.quadratic_per_m()].map(|it| factor * it);
        // Smaller coefficients than those of a valid noise are valid.
        let depth = DepthNoise::new(constant_m, quadratic_per_m).unwrap_or(self.depth);
        Self { lateral_m: factor * self.lateral_m, depth }
    }

    /// The standard deviation across the ray, in metres.
    pub fn lateral_m(&self) -> f64 {
        self.lateral_m
    }

    /// The noise of the depth.
    pub fn depth(&self) -> &DepthNoise {
        &self.depth
    }

    /// The covariance of a point, both in the optical frame, in metres and square metres.
    pub fn covariance(&self, point: &Point3<f64>) -> Matrix3<f64> {
        let ray = point.coords.normalize();
        let lateral = self.lateral_m.max(LEAST_SIGMA_M);
        // The depth is measured along the optical axis, and the ray is longer.
        let along = (self.depth.sigma_m(point.z) / ray.z).max(LEAST_SIGMA_M);
        let difference = along * along - lateral * lateral;
        Matrix3::identity() * (lateral * lateral) + ray * ray.transpose() * difference
    }
}

impl Default for PointNoise {
    fn default() -> Self {
        Self::D435
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn the_ray_has_the_noise_of_the_depth() {
        let depth = DepthNoise::new(0.018, 0.0).unwrap();
        let noise = PointNoise::new(0.004, depth).unwrap();
        let point = Point3::new(1.0, -2.0, 2.0);
        let covariance = noise.covariance(&point);
        let ray = point.coords.normalize();
        let across = Vector3::new(2.0, 1.0, 0.0).normalize();
        let sigma = |axis: Vector3<f64>| (axis.transpose() * covariance * axis).x.sqrt();
        assert!((sigma(ray) - 0.018 * 1.5).abs() < 1e-12);
        assert!((sigma(across) - 0.004).abs() < 1e-12);
        let mean = noise.averaged(100).covariance(&point);
        assert!((mean * 100.0 - covariance).norm() < 1e-12);
        assert!(PointNoise::new(f64::NAN, depth).is_err());
    }
}
