//! Depth images on the robots' own way from a frame to a scan.

use std::path::Path;

use clap::ValueEnum;
use ubimap_agent::sense::{self, Camera, Pick, Slice, Slicer, Validity};
use ubimap_protocol::units::Millimetres;

use super::sensor::Sensor;
use crate::recording::{depth_image::depths_mm, error::LogError, intrinsics::IntrinsicsFile};

/// Rows of a band.
const BAND: u16 = 5;

/// How far from a height the points of its slice may lie.
const TOLERANCE: Millimetres = Millimetres(20);

/// How depth images become scans.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Slicing {
    /// Which part of an image is mapped.
    pub slice: DepthSlice,
    /// What a column of it means.
    pub pixels: PixelModel,
}

/// Which part of a depth image is mapped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum DepthSlice {
    /// One row: that of the intrinsics, or the one on the optical axis
    #[default]
    Row,
    /// The median of five rows about it
    Band,
    /// The pixels that lie as high as the cameras do on average, however tilted they are
    Height,
}

/// What a column of a depth image means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum PixelModel {
    /// A pinhole camera's
    #[default]
    Pinhole,
    /// As wide an angle as any other, as Aluckal et al. have it (their equation 2)
    Linear,
}

/// How a camera stood when it took a frame.
pub(super) struct Stance {
    /// Looking down, in radians.
    pub(super) pitch: f64,
    /// The right side lowered, in radians.
    pub(super) roll: f64,
    /// Above the height that is sliced, in metres.
    pub(super) above_m: f64,
}

impl Slicing {
    /// What made the scans that [`Slicing::slice`] gives.
    pub(super) fn sensor(self, intrinsics: &IntrinsicsFile) -> Sensor {
        let IntrinsicsFile { fx, cx, width, .. } = *intrinsics;
        let width = width as usize;
        match (self.slice, self.pixels) {
            // A height comes in the columns of a level pinhole camera.
            (DepthSlice::Height, _) | (_, PixelModel::Pinhole) => Sensor::Pinhole { fx, cx, width },
            (_, PixelModel::Linear) => {
                let field_rad = field_rad(intrinsics);
                Sensor::LinearAngle { fx, field_rad, width }
            }
        }
    }

    /// A depth image to one reading for each column, in millimetres.
    pub(super) fn slice(
        self,
        path: &Path,
        intrinsics: &IntrinsicsFile,
        stance: &Stance,
    ) -> Result<Vec<u16>, LogError> {
        let depths = depths_mm(path, intrinsics)?;
        let (width, row, height) =
            (intrinsics.width as usize, intrinsics.row() as u16, intrinsics.height as u16);
        let slice = match self.slice {
            DepthSlice::Row => Slice::Row(row),
            DepthSlice::Band => {
                let rows = BAND.min(height);
                let first = row.saturating_sub(rows / 2).min(height - rows);
                Slice::Band { first, rows, pick: Pick::Median }
            }
            DepthSlice::Height => {
                let below = Millimetres::from_metres(stance.above_m);
                Slice::Height { below, tolerance: TOLERANCE }
            }
        };
        let mut buffer = vec![0; slice.buffer_len(width)];
        let camera = self.camera(intrinsics, stance);
        let mut slicer = Slicer::new(slice, camera, width, Validity::default(), &mut buffer);
        let readings = slicer.as_mut().map_err(|error| *error).and_then(|it| it.frame(&depths));
        // The slice was cut to the image above.
        Ok(readings.map(<[u16]>::to_vec).unwrap_or_default())
    }

    fn camera(self, intrinsics: &IntrinsicsFile, stance: &Stance) -> Camera {
        let IntrinsicsFile { fx, fy, cx, cy, .. } = *intrinsics;
        let focal = (fx as f32, fy.abs() as f32);
        let pixels = match self.pixels {
            PixelModel::Pinhole => sense::PixelModel::Pinhole,
            PixelModel::Linear => {
                sense::PixelModel::LinearAngle { field: field_rad(intrinsics) as f32 }
            }
        };
        let (pitch, roll) = (stance.pitch as f32, stance.roll as f32);
        Camera { pixels, pitch, roll, ..Camera::new(focal, (cx as f32, cy as f32)) }
    }
}

/// The angle between the outermost columns.
fn field_rad(intrinsics: &IntrinsicsFile) -> f64 {
    let IntrinsicsFile { fx, cx, width, .. } = *intrinsics;
    (cx / fx).atan() + ((f64::from(width) - 1.0 - cx) / fx).atan()
}
