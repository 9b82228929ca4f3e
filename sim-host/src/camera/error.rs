//! Errors of a camera's calibration.

/// Why a calibration is refused.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    /// The image has no pixels, or more than any sensor.
    #[error("an image of {0} x {1} pixels; give a width and a height from 1 to 16384")]
    Size(u32, u32),
    /// A focal length is not positive or not finite.
    #[error("focal lengths of {0} and {1} pixels; both must be positive")]
    Focal(f64, f64),
    /// The principal point is far outside the image, or not finite.
    #[error("an optical axis through pixel ({0}, {1}); it must be near the image")]
    Axis(f64, f64),
    /// A distortion coefficient is not finite, or the distortion folds the image over itself.
    #[error("distortion that folds the image over itself; check the order k1, k2, p1, p2, k3")]
    Distortion,
    /// The pose is not finite.
    #[error("a pose that is not finite")]
    Pose,
    /// A coefficient of the depth noise is negative, not finite or too large.
    #[error(
        "depth noise of {0} m plus {1}/m times the square of the depth; give a constant from 0 to \
         1 and a factor from 0 to 100"
    )]
    DepthNoise(f64, f64),
}
