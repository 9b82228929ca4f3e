//! AprilTags of the family 36h11 (Olson 2011; Wang and Olson 2016).

use apriltag::{Detector, DetectorBuilder, Family, Image, detector::QuadThresholds};
use measurements::Angle;
use noisy_float::prelude::r32;

use super::{
    image_region::ImageRegion,
    marker::{Identifier, Marker},
};
use crate::camera::Picture;

/// Maximum number of corrected modules. Tags of the family differ in at least eleven modules, so
/// more would be possible, but each additional one makes a random pattern twenty times as likely to
/// pass as a tag.
const CORRECTED: usize = 1;
/// Standard deviation of a corner's coordinates, in pixels. Rendered pictures show half of it; the
/// rest allows for a real lens and print.
const CORNER_NOISE_PX: f64 = 0.15;
/// Minimum contrast between black and white. The library's default of 5 finds edges everywhere in a
/// sensor's noise, and a frame of 1280 x 720 then takes ten times as long.
const CONTRAST: u8 = 30;
/// Minimum side of an image in pixels, larger than the eight modules of a tag: the library fails on
/// one or two rows.
const MIN_SIDE_PX: u32 = 12;
/// Alignment of rows in the detector's images, in bytes.
const ALIGNMENT: usize = 96;

/// Least height of a tag's picture, in pixels, at which tags are found in every heading: its side, seen at an angle.
pub const LEAST_HEIGHT_PX: f64 = 12.0;

/// Detects AprilTags.
#[derive(Debug)]
pub struct TagDetector {
    detector: Detector,
}

impl Default for TagDetector {
    fn default() -> Self {
        let builder = DetectorBuilder::new().add_family_bits(Family::tag_36h11(), CORRECTED);
        let mut detector = builder.build().expect("a detector that has a family");
        // No downsampling, because tags are small in the picture of a ceiling camera.
        detector.set_decimation(1.0);
        detector.set_refine_edges(true);
        detector.set_thread_number(1);
        detector.set_thresholds(thresholds());
        Self { detector }
    }
}

impl TagDetector {
    /// The tags that lie completely within a region of a picture. Takes about 10 ns per pixel in simple
    /// scenes and up to 30 ns.
    pub fn detect(&mut self, picture: &Picture, region: ImageRegion) -> Vec<Marker> {
        if region.width < MIN_SIDE_PX || region.height < MIN_SIDE_PX {
            return Vec::new();
        }
        let Some(image) = grey(picture, region) else { return Vec::new() };
        let detections = self.detector.detect(&image);
        let markers = detections.iter().filter_map(|detection| {
            let pixel = |[column, row]: [f64; 2]| {
                // The library puts the centre of the first pixel at 0.5.
                [column + f64::from(region.left) - 0.5, row + f64::from(region.top) - 0.5]
            };
            Some(Marker {
                identifier: Identifier::Tag(u16::try_from(detection.id()).ok()?),
                points: detection.corners().map(pixel).to_vec(),
                noise_px: CORNER_NOISE_PX,
            })
        });
        let mut markers: Vec<Marker> = markers.collect();
        markers.sort_by(|a, b| {
            let first = |marker: &Marker| marker.points[0][0];
            a.identifier.cmp(&b.identifier).then(first(a).total_cmp(&first(b)))
        });
        markers
    }
}

/// The library's defaults except for the contrast.
fn thresholds() -> QuadThresholds {
    let angle = 10f64.to_radians();
    QuadThresholds {
        min_cluster_pixels: 5,
        max_maxima_number: 10,
        min_angle: Angle::from_radians(angle),
        // The bindings pass this value on as the cosine itself.
        min_opposite_angle: Angle::from_radians(libm::cos(angle)),
        max_mse: r32(10.0),
        min_white_black_diff: CONTRAST,
        deglitch: false,
    }
}

/// The brightness of a region in the detector's format; `None` if the region exceeds the picture.
fn grey(picture: &Picture, region: ImageRegion) -> Option<Image> {
    let (width, rows) = (region.width as usize, region.height as usize);
    let mut image = Image::zeros_with_alignment(width, rows, ALIGNMENT).ok()?;
    let stride = image.stride();
    let buffer = image.as_slice_mut();
    for (row, line) in (region.top as usize..).zip(buffer.chunks_exact_mut(stride)).take(rows) {
        let line = line.get_mut(..width)?;
        match picture {
            Picture::Grey(grey) => {
                let first = row * grey.width() as usize + region.left as usize;
                line.copy_from_slice(grey.as_raw().get(first..first + width)?);
            }
            Picture::Colour(colour) => {
                let first = 3 * (row * colour.width() as usize + region.left as usize);
                let pixels = colour.as_raw().get(first..first + 3 * width)?.chunks_exact(3);
                for (to, pixel) in line.iter_mut().zip(pixels) {
                    // Luma by ITU-R BT.601, with weights in 1/256.
                    let [red, green, blue] = [pixel[0], pixel[1], pixel[2]].map(u32::from);
                    *to = ((77 * red + 150 * green + 29 * blue) >> 8) as u8;
                }
            }
        }
    }
    Some(image)
}

#[cfg(test)]
mod tests {
    use image::GrayImage;

    use super::*;

    #[test]
    fn regions_of_any_size_can_be_searched() {
        // Noise has edges everywhere.
        let noise =
            |x: u32, y: u32| (x.wrapping_mul(0x9E37_79B9) ^ y.wrapping_mul(0x85EB_CA6B)) >> 13;
        let picture =
            Picture::Grey(GrayImage::from_fn(64, 64, |x, y| image::Luma([noise(x, y) as u8])));
        let mut detector = TagDetector::default();
        for width in (1..40).chain([63, 64]) {
            for height in (1..40).chain([63, 64]) {
                let region = ImageRegion { left: 0, top: 0, width, height };
                assert!(detector.detect(&picture, region).is_empty(), "{width} x {height}");
            }
        }
    }
}
