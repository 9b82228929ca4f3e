//! Image files, decoded with limits on their size.

use std::{
    io::{BufReader, Cursor},
    path::Path,
};

use image::{
    ColorType, DynamicImage, GrayImage, ImageDecoder, ImageFormat, ImageReader, Limits,
    codecs::pnm::{PnmDecoder, PnmSubtype},
};

use super::occupancy::MAX_CELLS;
use crate::files;

/// Maximum number of bytes read from a file: four samples of two bytes per cell.
const MAX_BYTES: u64 = 8 * MAX_CELLS as u64;

/// Why an image can't be read. The caller adds the path.
#[derive(Debug, thiserror::Error)]
pub enum RasterError {
    /// The file can't be read.
    #[error("{0}")]
    Io(#[from] std::io::Error),
    /// Not an image of a supported format, or damaged.
    #[error("not a readable image: {0}")]
    Image(#[from] image::ImageError),
    /// More pixels than the maximum number of cells.
    #[error("{width} x {height} pixels are too many (the limit is {MAX_CELLS})")]
    TooLarge {
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// The image is empty.
    #[error("the image has no pixels")]
    Empty,
}

/// A decoded image.
pub(crate) struct Raster {
    /// The pixels; the first row is the top one. White is 255 or 65,535.
    pub(crate) image: DynamicImage,
    /// The sample value of white in the header of a PGM or PPM: the decoder scales smaller ranges
    /// to the full 8 or 16 bits.
    pub(crate) file_white: Option<u32>,
}

/// Reads a PNG, JPEG, BMP, PGM or PPM file; the format is detected from its content.
pub(crate) fn read(path: &Path) -> Result<Raster, RasterError> {
    decode(&files::read(path, MAX_BYTES)?)
}

/// The size (columns, rows) and pixel type of an image file, from its header.
pub(crate) fn look(path: &Path) -> Result<((u32, u32), ColorType), RasterError> {
    let decoder = ImageReader::new(BufReader::new(files::open(path, MAX_BYTES)?))
        .with_guessed_format()?
        .into_decoder()?;
    Ok((decoder.dimensions(), decoder.color_type()))
}

/// Decodes the contents of an image file.
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

/// Encodes an 8-bit grey image as a binary PGM (P5).
pub(crate) fn encode_pgm(image: &GrayImage) -> Vec<u8> {
    let mut bytes = format!("P5\n{} {}\n255\n", image.width(), image.height()).into_bytes();
    bytes.extend_from_slice(image.as_raw());
    bytes
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// One small image of every format used for maps, depth images and pictures.
    fn images() -> Vec<Vec<u8>> {
        let grey = GrayImage::from_fn(5, 4, |x, y| image::Luma([(50 * x + y) as u8]));
        let encoded = |image: DynamicImage, format| {
            let mut bytes = Cursor::new(Vec::new());
            image.write_to(&mut bytes, format).unwrap();
            bytes.into_inner()
        };
        let deep = DynamicImage::ImageLuma8(grey.clone()).into_luma16();
        vec![
            encode_pgm(&grey),
            b"P2 3 2 15 0 1 2 3 4 15".to_vec(),
            b"P5 2 2 1000 abcdefgh".to_vec(),
            encoded(deep.into(), ImageFormat::Png),
            encoded(DynamicImage::from(grey.clone()).into_rgba8().into(), ImageFormat::Png),
            encoded(DynamicImage::from(grey.clone()).into_rgb8().into(), ImageFormat::Bmp),
            encoded(DynamicImage::from(grey).into_rgb8().into(), ImageFormat::Jpeg),
            b"P3 2 1 255 1 2 3 4 5 6".to_vec(),
        ]
    }

    #[test]
    fn every_format_is_decoded() {
        for bytes in images() {
            assert!(decode(&bytes).is_ok());
        }
        assert_eq!(decode(&images()[1]).unwrap().file_white, Some(15));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(1_000))]

        #[test]
        fn garbled_images_never_panic(
            bytes in prop::sample::select(images()),
            at in any::<prop::sample::Index>(),
            byte in any::<u8>(),
            length in any::<prop::sample::Index>(),
            is_cut in any::<bool>(),
        ) {
            let mut bytes = bytes;
            let at = at.index(bytes.len());
            bytes[at] = byte;
            if is_cut {
                bytes.truncate(length.index(bytes.len() + 1));
            }
            let _ = decode(&bytes);
        }
    }
}
