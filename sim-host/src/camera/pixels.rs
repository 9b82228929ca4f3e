//! Pixel formats in which cameras deliver their images.

use image::{GrayImage, RgbImage};

use super::{DepthImage, Picture};

/// A pixel format, named by its four characters in Video4Linux.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelFormat {
    /// Depth in millimetres, two little-endian bytes.
    Z16,
    /// Two little-endian bytes of grey: a depth in millimetres.
    Y16,
    /// Red, green and blue, a byte each.
    Rgb3,
    /// Two pixels in four bytes, Y U Y V (ITU-R BT.601, limited range).
    Yuyv,
    /// A byte of grey.
    Grey,
}

impl PixelFormat {
    /// The formats of depth images, the preferred one first.
    pub const OF_DEPTH: [Self; 2] = [Self::Z16, Self::Y16];
    /// The formats of pictures, the preferred one first.
    pub const OF_PICTURES: [Self; 3] = [Self::Rgb3, Self::Yuyv, Self::Grey];

    /// The four characters.
    pub fn code(self) -> &'static [u8; 4] {
        match self {
            Self::Z16 => b"Z16 ",
            Self::Y16 => b"Y16 ",
            Self::Rgb3 => b"RGB3",
            Self::Yuyv => b"YUYV",
            Self::Grey => b"GREY",
        }
    }

    fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Z16 | Self::Y16 | Self::Yuyv => 2,
            Self::Rgb3 => 3,
            Self::Grey => 1,
        }
    }

    /// The bytes of the rows' pixels: `stride` bytes from row to row, of which the last may be missing.
    /// `None` if there are fewer rows.
    fn rows(self, bytes: &[u8], stride: usize, (width, height): (u32, u32)) -> Option<Vec<u8>> {
        let row = width as usize * self.bytes_per_pixel();
        let rows = bytes.chunks(stride.max(row).max(1)).take(height as usize);
        let pixels: Vec<u8> =
            rows.filter_map(|bytes| bytes.get(..row)).flatten().copied().collect();
        (pixels.len() == row * height as usize).then_some(pixels)
    }

    /// The depth image of this width and height, whose rows begin `stride` bytes after each other. `None` if
    /// there are too few bytes, or the format is one of pictures.
    pub fn depth(self, bytes: &[u8], stride: usize, size: (u32, u32)) -> Option<DepthImage> {
        Self::OF_DEPTH.contains(&self).then_some(())?;
        let rows = self.rows(bytes, stride, size)?;
        let depths = rows.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]));
        DepthImage::from_raw(size.0, size.1, depths.collect())
    }

    /// The picture, as [`depth`](Self::depth) is read.
    pub fn picture(self, bytes: &[u8], stride: usize, size: (u32, u32)) -> Option<Picture> {
        let (width, height) = size;
        let rows = self.rows(bytes, stride, size)?;
        match self {
            Self::Z16 | Self::Y16 => None,
            Self::Grey => GrayImage::from_raw(width, height, rows).map(Picture::Grey),
            Self::Rgb3 => RgbImage::from_raw(width, height, rows).map(Picture::Colour),
            Self::Yuyv => {
                let pairs = rows.chunks_exact(4).map(|pair| [pair[0], pair[1], pair[2], pair[3]]);
                let pixels =
                    pairs.flat_map(|[left, u, right, v]| [rgb(left, u, v), rgb(right, u, v)]);
                let pixels = pixels.flatten().collect();
                RgbImage::from_raw(width, height, pixels).map(Picture::Colour)
            }
        }
    }
}

/// Red, green and blue of a luminance from 16 to 235 and colour differences about 128 (ITU-R BT.601).
fn rgb(y: u8, u: u8, v: u8) -> [u8; 3] {
    let y = 298 * (i32::from(y) - 16) + 128;
    let (u, v) = (i32::from(u) - 128, i32::from(v) - 128);
    let parts = [y + 409 * v, y - 100 * u - 208 * v, y + 516 * u];
    parts.map(|part| (part >> 8).clamp(0, 255) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_may_be_longer_than_their_pixels() {
        let bytes = [1, 0, 2, 1, 9, 9, 3, 0, 4, 0];
        let depth = PixelFormat::Z16.depth(&bytes, 6, (2, 2)).unwrap();
        assert_eq!(depth.as_raw(), &[1, 258, 3, 4]);
        assert!(PixelFormat::Y16.depth(&bytes[..9], 6, (2, 2)).is_none());
        assert!(PixelFormat::Grey.depth(&bytes, 2, (2, 2)).is_none());
        assert!(PixelFormat::Z16.picture(&bytes, 6, (2, 2)).is_none());
        let Some(Picture::Grey(grey)) = PixelFormat::Grey.picture(&bytes, 6, (3, 2)) else {
            panic!("grey")
        };
        assert_eq!(grey.as_raw(), &[1, 0, 2, 3, 0, 4]);
    }

    #[test]
    fn the_primary_colours_are_told_from_luminance_and_differences() {
        // BT.601: white, black, red, green and blue.
        for (yuv, expected) in [
            ([235, 128, 128], [255, 255, 255]),
            ([16, 128, 128], [0, 0, 0]),
            ([81, 90, 240], [255, 0, 0]),
            ([145, 54, 34], [0, 255, 0]),
            ([41, 240, 110], [0, 0, 255]),
        ] {
            let [y, u, v] = yuv;
            let bytes = [y, u, 16, v];
            let Some(Picture::Colour(image)) = PixelFormat::Yuyv.picture(&bytes, 4, (2, 1)) else {
                panic!("colour")
            };
            let found = image.get_pixel(0, 0).0;
            assert!(found.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 2), "{found:?}");
        }
        let rgb = PixelFormat::Rgb3.picture(&[1, 2, 3], 3, (1, 1));
        assert!(matches!(rgb, Some(Picture::Colour(image)) if image.as_raw() == &[1, 2, 3]));
        assert!(PixelFormat::Yuyv.picture(&[1, 2], 2, (1, 1)).is_none(), "an odd width");
    }
}
