//! Frames as a stream of bytes, for cameras of other machines and programs.
//!
//! A sender connects to a Unix or TCP socket of the server and writes one frame after another: this
//! header, whose numbers are little-endian, then the depth image, then the picture.
//!
//! | bytes | content |
//! |---|---|
//! | 0..4 | `UBIF` |
//! | 4 | version: 1 |
//! | 5 | coding of the depth image: 0 none, 1 plain, 2 packed |
//! | 6 | coding of the picture: 0 none, 1 plain, 2 packed |
//! | 7 | channels of the picture: 1 grey, 3 red, green and blue; 0 without one |
//! | 8..16 | when it was captured, in microseconds of the sender's clock |
//! | 16..24 | when it is sent, by the same clock |
//! | 24..26, 26..28 | width and height of the depth image |
//! | 28..32 | number of bytes of the depth image |
//! | 32..34, 34..36 | width and height of the picture |
//! | 36..40 | number of bytes of the picture |
//!
//! A plain depth image has two bytes for each pixel, the depth along the optical axis in millimetres, 0
//! without a measurement; a packed one is the zlib stream of the differences of each pixel to its left
//! neighbour, modulo 65536, the first of each row as it is. A plain picture has a byte for each channel
//! of each pixel, a packed one is its zlib stream. Rows go from top to bottom.
//!
//! The clock may be any that counts microseconds; it is compared by the times of sending, and may be
//! set at any time. A sender that can't write should drop frames, not queue them. A connection on which
//! nothing arrives for two seconds is closed; the sender then connects again. `tests/python/send_camera.py`
//! is a sender.

use std::io::{self, Read, Write};

use flate2::{Compression, read::ZlibDecoder, write::ZlibEncoder};
use image::{GrayImage, RgbImage};

use super::{DepthImage, Picture};

/// Number of bytes of a header.
const HEADER: usize = 40;
const MAGIC: &[u8; 4] = b"UBIF";
const VERSION: u8 = 1;
/// Maximum number of pixels of an image.
const MAX_PIXELS: usize = 1 << 24;

/// A frame of a stream. Times are in microseconds of the sender's clock.
#[derive(Clone, Debug, PartialEq)]
pub struct StreamedFrame {
    /// When it was captured.
    pub captured: u64,
    /// When it was sent.
    pub sent: u64,
    /// The image of the depth sensor.
    pub depth: Option<DepthImage>,
    /// The image of the colour or grey sensor.
    pub picture: Option<Picture>,
}

/// Why a stream can't be read on. Each message is one line.
#[derive(Debug, thiserror::Error)]
pub enum StreamError {
    /// The connection has ended or failed.
    #[error("the connection has ended: {0}")]
    Io(#[from] io::Error),
    /// The bytes are not a stream of frames.
    #[error("not a stream of camera frames: {0}")]
    Format(&'static str),
}

/// Reads the next frame.
///
/// # Errors
/// Every [`StreamError`]; the stream can't be read on.
pub fn read(stream: &mut impl Read) -> Result<StreamedFrame, StreamError> {
    let mut header = [0; HEADER];
    stream.read_exact(&mut header)?;
    if &header[..4] != MAGIC {
        return Err(StreamError::Format("it does not begin with UBIF"));
    }
    if header[4] != VERSION {
        return Err(StreamError::Format("another version; this program knows version 1"));
    }
    let u16_at = |at: usize| u32::from(u16::from_le_bytes([header[at], header[at + 1]]));
    let u32_at = |at: usize| u16_at(at) | u16_at(at + 2) << 16;
    let u64_at = |at: usize| u64::from(u32_at(at)) | u64::from(u32_at(at + 4)) << 32;
    let (depth_size, picture_size) = ((u16_at(24), u16_at(26)), (u16_at(32), u16_at(34)));
    let depth = image(stream, header[5], depth_size, 2, u32_at(28))?;
    let channels = header[7];
    if header[6] != 0 && !matches!(channels, 1 | 3) {
        return Err(StreamError::Format("a picture needs 1 or 3 channels"));
    }
    let picture = image(stream, header[6], picture_size, channels.into(), u32_at(36))?;
    let is_packed = header[5] == 2;
    let depth = depth.and_then(|bytes| {
        let pixels = bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]));
        let mut pixels: Vec<u16> = pixels.collect();
        if is_packed {
            for row in pixels.chunks_exact_mut(depth_size.0.max(1) as usize) {
                row.iter_mut().fold(0_u16, |left, pixel| {
                    *pixel = pixel.wrapping_add(left);
                    *pixel
                });
            }
        }
        DepthImage::from_raw(depth_size.0, depth_size.1, pixels)
    });
    let (width, height) = picture_size;
    let picture = picture.and_then(|bytes| match channels {
        1 => GrayImage::from_raw(width, height, bytes).map(Picture::Grey),
        _ => RgbImage::from_raw(width, height, bytes).map(Picture::Colour),
    });
    Ok(StreamedFrame { captured: u64_at(8), sent: u64_at(16), depth, picture })
}

/// Reads the bytes of an image with `depth` bytes for each pixel; `None` if there is none.
fn image(
    stream: &mut impl Read,
    coding: u8,
    (width, height): (u32, u32),
    depth: usize,
    length: u32,
) -> Result<Option<Vec<u8>>, StreamError> {
    let pixels = width as usize * height as usize;
    let size = pixels * depth;
    match coding {
        0 if length == 0 => return Ok(None),
        0 => return Err(StreamError::Format("bytes of an image that is not there")),
        1 | 2 => {}
        _ => return Err(StreamError::Format("an unknown coding of an image")),
    }
    // Deflated noise grows by less than a thousandth.
    if pixels == 0 || pixels > MAX_PIXELS || length as usize > size + size / 64 + 1_024 {
        return Err(StreamError::Format("an image of an impossible size"));
    }
    let mut bytes = Vec::with_capacity(size);
    let mut encoded = stream.take(length.into());
    if coding == 1 {
        encoded.read_to_end(&mut bytes)?;
    } else {
        let mut zlib = ZlibDecoder::new(&mut encoded).take(size as u64 + 1);
        zlib.read_to_end(&mut bytes)?;
        io::copy(&mut encoded, &mut io::sink())?;
    }
    if encoded.limit() > 0 {
        return Err(StreamError::Io(io::ErrorKind::UnexpectedEof.into()));
    }
    if bytes.len() != size {
        return Err(StreamError::Format("an image with too few or too many bytes"));
    }
    Ok(Some(bytes))
}

/// Writes a frame, with a packed depth image and a plain picture.
///
/// # Errors
/// The stream's.
pub fn write(stream: &mut impl Write, frame: &StreamedFrame) -> io::Result<()> {
    let StreamedFrame { captured, sent, depth, picture } = frame;
    let packed = depth.as_ref().map(packed).transpose()?;
    let (channels, size, plain) = match picture {
        None => (0, (0, 0), &[][..]),
        Some(Picture::Grey(image)) => (1, image.dimensions(), &image.as_raw()[..]),
        Some(Picture::Colour(image)) => (3, image.dimensions(), &image.as_raw()[..]),
    };
    let depth_size = depth.as_ref().map_or((0, 0), |image| image.dimensions());
    let packed = packed.unwrap_or_default();
    let mut header = Vec::with_capacity(HEADER);
    header.extend(MAGIC);
    header.extend([VERSION, if depth.is_some() { 2 } else { 0 }, u8::from(channels > 0), channels]);
    header.extend(captured.to_le_bytes());
    header.extend(sent.to_le_bytes());
    for ((width, height), bytes) in [(depth_size, &packed[..]), (size, plain)] {
        header.extend((width as u16).to_le_bytes());
        header.extend((height as u16).to_le_bytes());
        header.extend((bytes.len() as u32).to_le_bytes());
    }
    stream.write_all(&header)?;
    stream.write_all(&packed)?;
    stream.write_all(plain)
}

/// A depth image, packed.
fn packed(image: &DepthImage) -> io::Result<Vec<u8>> {
    let mut zlib = ZlibEncoder::new(Vec::new(), Compression::fast());
    for row in image.as_raw().chunks_exact(image.width().max(1) as usize) {
        let mut left = 0;
        let bytes: Vec<u8> = row
            .iter()
            .flat_map(|&pixel| {
                pixel.wrapping_sub(std::mem::replace(&mut left, pixel)).to_le_bytes()
            })
            .collect();
        zlib.write_all(&bytes)?;
    }
    zlib.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames() -> Vec<StreamedFrame> {
        let depth = DepthImage::from_fn(5, 3, |x, y| {
            image::Luma([(x * 40_000 + y * 7) as u16 * u16::from(x != 2)])
        });
        let grey = GrayImage::from_fn(4, 2, |x, y| image::Luma([(x * 50 + y) as u8]));
        let colour = RgbImage::from_fn(4, 2, |x, y| image::Rgb([x as u8, y as u8, 255]));
        let frame = |depth, picture| StreamedFrame {
            captured: 1_000_000_000_000,
            sent: 1_000_000_000_900,
            depth,
            picture,
        };
        vec![
            frame(Some(depth.clone()), Some(Picture::Colour(colour))),
            frame(None, Some(Picture::Grey(grey))),
            frame(Some(depth), None),
            frame(None, None),
        ]
    }

    #[test]
    fn frames_are_read_as_they_were_written() {
        let mut stream = Vec::new();
        frames().iter().for_each(|frame| write(&mut stream, frame).unwrap());
        let mut rest = &stream[..];
        for frame in frames() {
            assert_eq!(read(&mut rest).unwrap(), frame);
        }
        assert!(matches!(read(&mut rest), Err(StreamError::Io(_))));
    }

    #[test]
    fn a_stream_that_is_cut_or_altered_gives_an_error_or_an_image_of_the_stated_size() {
        let mut stream = Vec::new();
        write(&mut stream, &frames()[0]).unwrap();
        for length in 0..stream.len() {
            assert!(read(&mut &stream[..length]).is_err(), "{length}");
        }
        for index in 0..stream.len() {
            for bit in 0..8 {
                let mut altered = stream.clone();
                altered[index] ^= 1 << bit;
                if let Ok(StreamedFrame { depth: Some(depth), .. }) = read(&mut &altered[..]) {
                    let pixels = depth.width() * depth.height();
                    assert_eq!(depth.as_raw().len(), pixels as usize);
                }
            }
        }
        for (index, value, told) in [
            (0, 0, "UBIF"),
            (4, 2, "version"),
            (5, 3, "coding"),
            (7, 2, "channels"),
            (27, 255, "too few"),
        ] {
            let mut altered = stream.clone();
            altered[index] = value;
            let error = read(&mut &altered[..]).unwrap_err().to_string();
            assert!(error.contains(told), "{error}");
        }
    }
}
