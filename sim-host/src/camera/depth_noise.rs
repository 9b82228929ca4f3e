//! The noise model of a depth sensor.

use super::error::CalibrationError;

/// The standard deviation of a depth sensor's errors along the optical axis, as a function of the depth
/// z in metres:
///
/// ```text
/// sigma(z) = constant + quadratic * z^2
/// ```
///
/// The quadratic term comes from triangulation, by stereo or structured light: the depth is z = f B / d,
/// so an error of the disparity d grows by z^2 / (f B). The constant term covers everything that does not
/// depend on the depth: rounding to millimetres, or all of a time-of-flight sensor's noise.
///
/// | sensor | constant (m) | quadratic (1/m) | source |
/// |---|---|---|---|
/// | [`D435`](Self::D435) | 0.001 | 0.00475 | disparity noise 0.08 px (Intel, *Tuning D435 and D415*) |
/// | Kinect v1 | 0 | 0.001425 | Khoshelham and Elberink, *Sensors* 12 (2012), eq. 6 |
///
/// For another sensor, take images of a wall at a few distances, compute the standard deviation of
/// single pixels, and fit both terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthNoise {
    constant_m: f64,
    quadratic_per_m: f64,
}

/// The constant term of stereo sensors: depths are rounded to millimetres.
const ROUNDING_M: f64 = 0.001;

impl DepthNoise {
    /// An Intel RealSense D435 at 640 x 480: focal length 337 px, baseline 50 mm, disparity noise
    /// 0.08 px. Gives 6 mm at 1 m and 77 mm at 4 m.
    pub const D435: Self = Self { constant_m: ROUNDING_M, quadratic_per_m: 0.08 / (337.0 * 0.050) };

    /// Maximum accepted coefficients, in metres and 1/m: far beyond those of any real sensor.
    const MAX_CONSTANT_M: f64 = 1.0;
    const MAX_QUADRATIC_PER_M: f64 = 100.0;

    /// Noise with these coefficients, in metres and in 1/m.
    ///
    /// # Errors
    /// [`CalibrationError::DepthNoise`] if one is negative, not finite, or beyond 1 m or 100/m.
    pub fn new(constant_m: f64, quadratic_per_m: f64) -> Result<Self, CalibrationError> {
        if (0.0..=Self::MAX_CONSTANT_M).contains(&constant_m)
            && (0.0..=Self::MAX_QUADRATIC_PER_M).contains(&quadratic_per_m)
        {
            Ok(Self { constant_m, quadratic_per_m })
        } else {
            Err(CalibrationError::DepthNoise(constant_m, quadratic_per_m))
        }
    }

    /// The noise of a stereo sensor, from its focal length in pixels, its baseline in metres and the
    /// standard deviation of its disparities in pixels.
    ///
    /// # Errors
    /// Every error of [`DepthNoise::new`].
    pub fn stereo(
        focal_px: f64,
        baseline_m: f64,
        disparity_px: f64,
    ) -> Result<Self, CalibrationError> {
        Self::new(ROUNDING_M, disparity_px / (focal_px * baseline_m))
    }

    /// The constant term, in metres.
    pub fn constant_m(&self) -> f64 {
        self.constant_m
    }

    /// The coefficient of the squared depth, in 1/m.
    pub fn quadratic_per_m(&self) -> f64 {
        self.quadratic_per_m
    }

    /// The standard deviation at a depth, both in metres.
    pub fn sigma_m(&self, depth_m: f64) -> f64 {
        self.constant_m + self.quadratic_per_m * depth_m * depth_m
    }
}

impl Default for DepthNoise {
    /// A D435: the most common sensor that is cheap enough for a ceiling, and one of the noisiest.
    fn default() -> Self {
        Self::D435
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_d435_is_good_to_two_percent_of_four_metres() {
        let sigma_m = DepthNoise::D435.sigma_m(4.0);
        assert!((0.075..0.080).contains(&sigma_m), "{sigma_m}");
        let stereo = DepthNoise::stereo(337.0, 0.05, 0.08).unwrap();
        assert!((stereo.sigma_m(4.0) - sigma_m).abs() < 1e-9);
    }

    #[test]
    fn coefficients_of_no_sensor_are_refused() {
        for (constant_m, quadratic_per_m) in
            [(-0.001, 0.0), (0.0, -1e-9), (f64::NAN, 0.0), (0.0, f64::INFINITY), (1.1, 0.0)]
        {
            assert!(DepthNoise::new(constant_m, quadratic_per_m).is_err());
        }
        assert!(DepthNoise::stereo(1.0, 0.0, 0.08).is_err());
        assert_eq!(DepthNoise::new(0.0, 0.0).unwrap().sigma_m(5.0), 0.0);
    }
}
