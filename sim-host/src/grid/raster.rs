//! Image files, decoded within bounds.

use std::{io::Cursor, path::Path};

use image::{
    DynamicImage, GrayImage, ImageDecoder, ImageFormat, ImageReader, Limits,
    codecs::pnm::{PnmDecoder, PnmSubtype},
};

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

/// A decoded image.
pub(crate) struct Raster {
    /// The pixels; the first row is the top one. White is 255 or 65,535.
    pub(crate) image: DynamicImage,
    /// What white was in the file, where the header of a PGM or PPM says so: the decoder spreads
    /// smaller ranges over the whole of 8 or 16 bits.
    pub(crate) file_white: Option<u32>,
}

/// Reads a PNG, PGM or BMP file; its kind is told from its content.
pub(crate) fn read(path: &Path) -> Result<Raster, RasterError> {
    decode(&std::fs::read(path)?)
}

/// Decodes the bytes of a PNG, PGM or BMP file.
pub(crate) fn decode(bytes: &[u8]) -> Result<Raster, RasterError> {
    if image::guess_format(bytes)? == ImageFormat::Pnm {
        let decoder = PnmDecoder::new(Cursor::new(bytes))?;
        let header = decoder.header();
        let graduated = matches!(header.subtype(), PnmSubtype::Graymap(_) | PnmSubtype::Pixmap(_));
        let file_white = graduated.then_some(header.maximal_sample());
        decode_with(decoder, file_white)
    } else {
        let reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format()?;
        decode_with(reader.into_decoder()?, None)
    }
}

fn decode_with(
    mut decoder: impl ImageDecoder,
    file_white: Option<u32>,
) -> Result<Raster, RasterError> {
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 {
        return Err(RasterError::Empty);
    }
    if u64::from(width) * u64::from(height) > MAX_CELLS as u64 {
        return Err(RasterError::TooLarge { width, height });
    }
    decoder.set_limits(Limits::default())?;
    let image = DynamicImage::from_decoder(decoder)?;
    Ok(Raster { image, file_white })
}

/// An image of 8-bit grey as the bytes of a binary PGM (P5).
pub(crate) fn encode_pgm(image: &GrayImage) -> Vec<u8> {
    let mut bytes = format!("P5\n{} {}\n255\n", image.width(), image.height()).into_bytes();
    bytes.extend_from_slice(image.as_raw());
    bytes
}
