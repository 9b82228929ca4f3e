//! A rectangle of a picture in which markers are searched.

use crate::camera::Picture;

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageRegion {
    /// The first column.
    pub left: u32,
    /// The first row.
    pub top: u32,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
}

impl ImageRegion {
    /// The whole picture.
    pub fn all(picture: &Picture) -> Self {
        let (width, height) = size(picture);
        Self { left: 0, top: 0, width, height }
    }

    /// The pixels within `reach` columns and rows of a centre; `None` if they are all outside the
    /// picture.
    pub fn about([column, row]: [f64; 2], reach: f64, picture: &Picture) -> Option<Self> {
        let (width, height) = size(picture);
        let span = |middle: f64, size: u32| {
            let bound = |at: f64| at.clamp(0.0, f64::from(size)) as u32;
            let (first, end) = (bound((middle - reach).floor()), bound((middle + reach).ceil()));
            (first < end).then_some((first, end - first))
        };
        let (left, width) = span(column, width)?;
        let (top, height) = span(row, height)?;
        Some(Self { left, top, width, height })
    }

    /// The smallest region that contains both.
    pub fn with(&self, other: &Self) -> Self {
        let (left, top) = (self.left.min(other.left), self.top.min(other.top));
        let right = (self.left + self.width).max(other.left + other.width);
        let bottom = (self.top + self.height).max(other.top + other.height);
        Self { left, top, width: right - left, height: bottom - top }
    }

    /// Number of pixels.
    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }
}

fn size(picture: &Picture) -> (u32, u32) {
    match picture {
        Picture::Grey(image) => image.dimensions(),
        Picture::Colour(image) => image.dimensions(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_region_ends_where_the_picture_does() {
        let picture = Picture::Grey(image::GrayImage::new(100, 50));
        let about = |middle, reach| ImageRegion::about(middle, reach, &picture);
        let corner = ImageRegion { left: 0, top: 40, width: 15, height: 10 };
        assert_eq!(about([5.0, 50.0], 10.0), Some(corner));
        assert_eq!(about([-50.0, 25.0], 10.0), None);
        assert_eq!(about([f64::NAN, 25.0], 10.0), None);
        assert_eq!(about([50.0, 25.0], 1e9), Some(ImageRegion::all(&picture)));
        let other = ImageRegion { left: 14, top: 0, width: 2, height: 41 };
        assert_eq!(other.pixels(), 82);
        assert_eq!(corner.with(&other), ImageRegion { left: 0, top: 0, width: 16, height: 50 });
    }
}
