//! The sensor of a log's scans.

use ubimap_agent::sense::{Camera, PixelModel, SensorModel};

/// The directions of a scan's readings in the frame of the sensor: x forward, y left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Sensor {
    /// Readings are distances along beams. Angles in radians, counter-clockwise from x.
    Radial {
        /// Angle of beam 0, the clockwise-most one.
        first_rad: f64,
        /// Angle from one beam to the next.
        step_rad: f64,
        /// Number of readings in a scan.
        beams: usize,
    },
    /// Readings are depths along x, one for each image column `u` from the left: the point is
    /// x = depth, y = (cx - u) * depth / fx.
    Pinhole {
        /// Focal length in pixels.
        fx: f64,
        /// Column of the principal point.
        cx: f64,
        /// Number of readings in a scan.
        width: usize,
    },
    /// Depths along x of image columns that are assumed to subtend equal angles: the point is
    /// y = x * tan(field / 2 * (n / 2 - u) / (n / 2)) for n columns (Aluckal, equation 2).
    LinearAngle {
        /// Focal length in pixels.
        fx: f64,
        /// Angle between the outermost columns in radians.
        field_rad: f64,
        /// Number of readings in a scan.
        width: usize,
    },
}

impl Sensor {
    /// Number of readings in a scan.
    pub fn readings(&self) -> usize {
        match self {
            Self::Radial { beams, .. } => *beams,
            Self::Pinhole { width, .. } | Self::LinearAngle { width, .. } => *width,
        }
    }

    /// The sensor model in the robot's configuration.
    pub fn model(&self) -> SensorModel {
        match *self {
            Self::Radial { first_rad, step_rad, .. } => {
                SensorModel::Radial { first: first_rad as f32, step: step_rad as f32 }
            }
            Self::Pinhole { fx, cx, .. } => {
                SensorModel::Pinhole { focal: fx as f32, centre: cx as f32 }
            }
            Self::LinearAngle { fx, field_rad, .. } => {
                let pixels = PixelModel::LinearAngle { field: field_rad as f32 };
                let camera = Camera::new((fx as f32, fx as f32), (0.0, 0.0));
                SensorModel::Row { camera: Camera { pixels, ..camera }, row: 0.0 }
            }
        }
    }
}
