//! Image files, decoded within bounds.

use std::{io::Cursor, path::Path};

use image::{DynamicImage, GrayImage, ImageDecoder, ImageReader, Limits};

use super::occupancy::MAX_CELLS;

/// Why an image can't be read; the path is the caller's to name.
#[derive(Debug, thiserror::Error)]
pub enum RasterError {
    /// The file can't be read.
    #[error("{0}")]
    Io(#[from] std::io::Error),
    /// Not an image of a known kind, or a damaged one.
    #[error("not a readable image: {0}")]
    Image(#[from] image::ImageError),
    /// More pixels than a map may have cells.
    #[error("{width} x {height} pixels are too many (the limit is {MAX_CELLS})")]
    TooLarge {
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// No pixels.
    #[error("the image has no pixels")]
    Empty,
}

/// Reads a PNG, PGM or BMP file; its kind is told from its content. White is 255 or 65,535: the
/// decoder spreads the smaller ranges that a PGM may have.
pub(crate) fn read(path: &Path) -> Result<DynamicImage, RasterError> {
    decode(&std::fs::read(path)?)
}

fn decode(bytes: &[u8]) -> Result<DynamicImage, RasterError> {
    let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format()?;
    let mut decoder = reader.into_decoder()?;
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 {
        return Err(RasterError::Empty);
    }
    if u64::from(width) * u64::from(height) > MAX_CELLS as u64 {
        return Err(RasterError::TooLarge { width, height });
    }
    decoder.set_limits(Limits::default())?;
    Ok(DynamicImage::from_decoder(decoder)?)
}

/// An image of 8-bit grey as the bytes of a binary PGM (P5).
pub(crate) fn encode_pgm(image: &GrayImage) -> Vec<u8> {
    let mut bytes = format!("P5\n{} {}\n255\n", image.width(), image.height()).into_bytes();
    bytes.extend_from_slice(image.as_raw());
    bytes
}
