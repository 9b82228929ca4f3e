//! What the cameras have seen: landmarks and the floor.

use std::collections::BTreeSet;

use nalgebra::{Matrix3, Point3, UnitVector3, Vector3};

use super::point_noise::{LateralNoiseError, PointNoise};
use crate::camera::CalibrationError;

/// The landmarks and floors that the cameras of a room have seen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Observations {
    /// Each camera, by its index.
    pub cameras: Vec<CameraObservations>,
}

/// What one camera has seen.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraObservations {
    /// The camera's name.
    pub name: String,
    /// The landmarks: the paper's `P_i`.
    pub landmarks: Vec<Landmark>,
    /// The floor, if it was found.
    pub floor: Option<Floor>,
}

/// A landmark seen by a camera: the paper's `p_i^k`.
#[derive(Clone, Debug, PartialEq)]
pub struct Landmark {
    /// Its position in the camera's optical frame (x right, y down, z forward), in metres.
    pub position: Point3<f64>,
    /// Its name, the same in every camera; a landmark that moves has another name at each moment.
    pub label: Option<String>,
    /// The noise of the position.
    pub noise: PointNoise,
}

/// The floor's plane seen by a camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Floor {
    /// The floor's upward normal in the optical frame.
    pub normal: UnitVector3<f64>,
    /// Height of the optical centre above the floor, in metres.
    pub height_m: f64,
    /// Standard deviation of each of the normal's two angles, in radians.
    pub normal_sigma_rad: f64,
    /// Standard deviation of the height, in metres.
    pub height_sigma_m: f64,
    /// If the camera's landmarks were placed where their rays meet a height above this floor, so that its
    /// error is common to all of them: the covariance of its normal along
    /// [`FloorPlane::axes`](crate::perception::FloorPlane::axes), in radians, and of its height, in metres.
    pub placing: Option<Matrix3<f64>>,
}

/// Why observations can't be used. The key is that of the file: `cameras[1].landmarks[3]`.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ObservationsError {
    /// No camera.
    #[error("no cameras; give each camera as a [[cameras]] table")]
    Empty,
    /// Two cameras have one name, or a camera has none.
    #[error("cameras[{camera}].name: {name:?} must be unique and not empty")]
    Name {
        /// The camera's index.
        camera: usize,
        /// Its name.
        name: String,
    },
    /// A landmark isn't in front of its camera.
    #[error(
        "cameras[{camera}].landmarks[{landmark}]: must be in front of the camera, z from 0.01 to \
         1000 m (x right, y down, z forward)"
    )]
    Position {
        /// The camera's index.
        camera: usize,
        /// The landmark's index.
        landmark: usize,
    },
    /// A camera has two landmarks with one label.
    #[error(
        "cameras[{camera}].landmarks[{landmark}]: another landmark of this camera is labelled \
         {label:?}; give the mean, or different labels for different moments"
    )]
    Repeated {
        /// The camera's index.
        camera: usize,
        /// The landmark's index.
        landmark: usize,
        /// The label.
        label: String,
    },
    /// A floor is not finite or its standard deviations are not positive.
    #[error(
        "cameras[{camera}].floor: give a height above 0 m, and sigmas above 0 (at most 90 degrees and \
         10 m)"
    )]
    Floor {
        /// The camera's index.
        camera: usize,
    },
    /// The noise across the ray is invalid.
    #[error(transparent)]
    Noise(#[from] LateralNoiseError),
    /// The noise of the depth is invalid.
    #[error(transparent)]
    Depth(#[from] CalibrationError),
}

/// Bounds of a landmark's coordinates, in metres.
const NEAREST_M: f64 = 0.01;
const FARTHEST_M: f64 = 1000.0;

impl Landmark {
    /// The covariance of the position in the optical frame, in square metres.
    pub fn covariance(&self) -> Matrix3<f64> {
        self.noise.covariance(&self.position)
    }
}

impl Floor {
    /// Usual standard deviation of the angles of a plane through thousands of depth pixels.
    pub const NORMAL_SIGMA_RAD: f64 = 0.2 * std::f64::consts::PI / 180.0;
    /// Usual standard deviation of the height.
    pub const HEIGHT_SIGMA_M: f64 = 0.01;

    /// A floor with the usual standard deviations. `normal` is in the optical frame and points up;
    /// its length is ignored. `None` if it has none.
    pub fn new(normal: Vector3<f64>, height_m: f64) -> Option<Self> {
        Some(Self {
            normal: UnitVector3::try_new(normal, 1e-9)?,
            height_m,
            normal_sigma_rad: Self::NORMAL_SIGMA_RAD,
            height_sigma_m: Self::HEIGHT_SIGMA_M,
            placing: None,
        })
    }

    fn is_valid(&self) -> bool {
        let is_within = |value: f64, most: f64| value > 0.0 && value <= most;
        self.normal.iter().all(|it| it.is_finite())
            && is_within(self.height_m, FARTHEST_M)
            && is_within(self.normal_sigma_rad, std::f64::consts::FRAC_PI_2)
            && is_within(self.height_sigma_m, 10.0)
    }
}

impl Observations {
    /// Checks names, labels, positions and floors.
    ///
    /// # Errors
    /// Every [`ObservationsError`] except those of noise, which are those of its constructor.
    pub fn check(&self) -> Result<(), ObservationsError> {
        if self.cameras.is_empty() {
            return Err(ObservationsError::Empty);
        }
        let mut names = BTreeSet::new();
        for (camera, seen) in self.cameras.iter().enumerate() {
            if seen.name.is_empty() || !names.insert(&seen.name) {
                return Err(ObservationsError::Name { camera, name: seen.name.clone() });
            }
            seen.check(camera)?;
        }
        Ok(())
    }

    /// The index of the camera of this name.
    pub fn camera(&self, name: &str) -> Option<usize> {
        self.cameras.iter().position(|camera| camera.name == name)
    }
}

impl CameraObservations {
    fn check(&self, camera: usize) -> Result<(), ObservationsError> {
        let mut labels = BTreeSet::new();
        for (landmark, seen) in self.landmarks.iter().enumerate() {
            let at = &seen.position;
            let is_bounded = at.iter().all(|it| it.abs() <= FARTHEST_M);
            if !(is_bounded && at.z >= NEAREST_M) {
                return Err(ObservationsError::Position { camera, landmark });
            }
            if let Some(label) = seen.label.as_ref().filter(|it| !labels.insert(*it)) {
                let label = label.clone();
                return Err(ObservationsError::Repeated { camera, landmark, label });
            }
        }
        match &self.floor {
            Some(floor) if !floor.is_valid() => Err(ObservationsError::Floor { camera }),
            _ => Ok(()),
        }
    }
}
