//! 16-bit depth images on disk.

use std::path::Path;

use image::DynamicImage;

use super::{
    error::{FrameFault, LogError},
    intrinsics::IntrinsicsFile,
};
use crate::grid::raster::{self, Raster};

/// Reads the depths of an image in millimetres, row by row; 0 for no measurement.
pub(super) fn depths_mm(path: &Path, intrinsics: &IntrinsicsFile) -> Result<Vec<u16>, LogError> {
    let refuse = |fault| LogError::Frame { path: path.to_owned(), fault };
    let Raster { image, file_white } =
        raster::read(path).map_err(|error| refuse(FrameFault::Image(error)))?;
    let DynamicImage::ImageLuma16(image) = image else { return Err(refuse(FrameFault::NotDepth)) };
    if image.dimensions() != (intrinsics.width, intrinsics.height) {
        let (width, height) = image.dimensions();
        let (expected_width, expected_height) = (intrinsics.width, intrinsics.height);
        return Err(refuse(FrameFault::Size { width, height, expected_width, expected_height }));
    }
    // The decoder scales samples of smaller ranges up to 16 bits. This is undone here.
    let spread = f64::from(u16::MAX) / f64::from(file_white.unwrap_or(u32::from(u16::MAX)));
    let depths = image.as_raw().iter().map(|&sample| {
        let depth_mm = (f64::from(sample) / spread).round() * 1000.0 / intrinsics.depth_per_metre;
        // A saturated sample is not a measurement.
        let is_measured = sample < u16::MAX && depth_mm.round() <= f64::from(u16::MAX);
        if is_measured { depth_mm.round() as u16 } else { 0 }
    });
    Ok(depths.collect())
}
