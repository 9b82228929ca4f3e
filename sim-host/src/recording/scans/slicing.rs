//! Converts depth images to scans, with the same code as on robots.

use std::path::Path;

use clap::ValueEnum;
use ubimap_agent::sense::{self, Camera, Pick, Slice, Slicer, Validity};
use ubimap_protocol::units::Millimetres;

use super::sensor::Sensor;
use crate::recording::{
    depth_image::depths_mm,
    error::LogError,
    exposure::{ExposureCounts, ExposureRule},
    intrinsics::IntrinsicsFile,
};

/// Number of rows in a band.
const BAND: u16 = 5;

/// Maximum distance of points from the height of a slice.
const TOLERANCE: Millimetres = Millimetres(20);

/// How depth images are converted to scans.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Slicing {
    /// The part of an image that is mapped.
    pub slice: DepthSlice,
    /// The model of the image's columns.
    pub pixels: PixelModel,
    /// What is done with badly exposed pixels.
    pub exposure: ExposureRule,
    /// The up axis of the world in which the cameras' poses are given.
    pub up: UpAxis,
    /// Units of the depth images per metre, instead of what the intrinsics state.
    pub depth_per_metre: Option<f64>,
}

/// The up axis of the world of a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum UpAxis {
    /// Against the world's x
    #[value(name = "-x")]
    MinusX,
    /// The world's x
    X,
    /// Against the world's y
    #[value(name = "-y")]
    MinusY,
    /// The world's y
    Y,
    /// Against the world's z
    #[value(name = "-z")]
    MinusZ,
    /// The world's z
    #[default]
    Z,
    /// The mean of the images' up axes: for cameras that were held level
    Cameras,
}

/// The part of a depth image that is mapped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum DepthSlice {
    /// One row: the one in the intrinsics, or the one on the optical axis
    #[default]
    Row,
    /// The median of five rows around that row
    Band,
    /// The pixels at the mean height of the cameras, whatever their tilt
    Height,
}

/// The model of a depth image's columns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum PixelModel {
    /// A pinhole camera
    #[default]
    Pinhole,
    /// Equal angles for all columns, as in Aluckal et al. (equation 2)
    Linear,
}

/// The attitude and height of a camera at one frame.
pub(super) struct Stance {
    /// Downward pitch in radians.
    pub(super) pitch: f64,
    /// Roll with the right side lowered, in radians.
    pub(super) roll: f64,
    /// Height above the slice in metres.
    pub(super) above_m: f64,
}

impl Slicing {
    /// The sensor of the scans that [`Slicing::slice`] returns.
    pub(super) fn sensor(self, intrinsics: &IntrinsicsFile) -> Sensor {
        let IntrinsicsFile { fx, cx, width, .. } = *intrinsics;
        let width = width as usize;
        match (self.slice, self.pixels) {
            // A slice at a height has the columns of a level pinhole camera.
            (DepthSlice::Height, _) | (_, PixelModel::Pinhole) => Sensor::Pinhole { fx, cx, width },
            (_, PixelModel::Linear) => {
                let field_rad = field_rad(intrinsics);
                Sensor::LinearAngle { fx, field_rad, width }
            }
        }
    }

    /// Slices a depth image, without what is badly exposed in its picture. Returns one reading for each
    /// column, in millimetres.
    pub(super) fn slice(
        self,
        (path, picture): (&Path, Option<&Path>),
        intrinsics: &IntrinsicsFile,
        stance: &Stance,
    ) -> Result<(Vec<u16>, ExposureCounts), LogError> {
        let mut depths = depths_mm(path, intrinsics)?;
        let size = (intrinsics.width, intrinsics.height);
        let apply = |picture| self.exposure.apply_file(&mut depths, size, picture);
        let counts = picture.map(apply).transpose()?.unwrap_or_default();
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
        // This can't fail, because the slice was clipped to the image above.
        Ok((readings.map(<[u16]>::to_vec).unwrap_or_default(), counts))
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

/// The angle between the outermost columns in radians.
fn field_rad(intrinsics: &IntrinsicsFile) -> f64 {
    let IntrinsicsFile { fx, cx, width, .. } = *intrinsics;
    (cx / fx).atan() + ((f64::from(width) - 1.0 - cx) / fx).atan()
}
