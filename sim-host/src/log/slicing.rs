//! Depth images on the robots' own way from a frame to a scan.

use std::path::Path;

use clap::ValueEnum;
use image::DynamicImage;
use ubimap_agent::sense::{self, Camera, Pick, Slice, Slicer, Validity};
use ubimap_protocol::units::Millimetres;

use super::{FrameFault, LogError, Sensor, intrinsics::Intrinsics};
use crate::grid::raster::{self, Raster};

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
    pub(super) fn sensor(self, intrinsics: &Intrinsics) -> Sensor {
        let Intrinsics { fx, cx, width, .. } = *intrinsics;
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
        intrinsics: &Intrinsics,
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

    fn camera(self, intrinsics: &Intrinsics, stance: &Stance) -> Camera {
        let Intrinsics { fx, fy, cx, cy, .. } = *intrinsics;
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
fn field_rad(intrinsics: &Intrinsics) -> f64 {
    let Intrinsics { fx, cx, width, .. } = *intrinsics;
    (cx / fx).atan() + ((f64::from(width) - 1.0 - cx) / fx).atan()
}

/// The depths of an image in millimetres, row by row; 0 where nothing was measured.
pub(super) fn depths_mm(path: &Path, intrinsics: &Intrinsics) -> Result<Vec<u16>, LogError> {
    let refuse = |fault| LogError::Frame { path: path.to_owned(), fault };
    let Raster { image, file_white } =
        raster::read(path).map_err(|error| refuse(FrameFault::Image(error)))?;
    let DynamicImage::ImageLuma16(image) = image else { return Err(refuse(FrameFault::NotDepth)) };
    if image.dimensions() != (intrinsics.width, intrinsics.height) {
        let (width, height) = image.dimensions();
        let (expected_width, expected_height) = (intrinsics.width, intrinsics.height);
        return Err(refuse(FrameFault::Size { width, height, expected_width, expected_height }));
    }
    // The decoder spread a smaller range over all 16 bits: back to the file's numbers.
    let spread = f64::from(u16::MAX) / f64::from(file_white.unwrap_or(u32::from(u16::MAX)));
    let depths = image.as_raw().iter().map(|&sample| {
        let depth_mm = (f64::from(sample) / spread).round() * 1000.0 / intrinsics.depth_per_metre;
        // A saturated sample measured nothing.
        let is_measured = sample < u16::MAX && depth_mm.round() <= f64::from(u16::MAX);
        if is_measured { depth_mm.round() as u16 } else { 0 }
    });
    Ok(depths.collect())
}
