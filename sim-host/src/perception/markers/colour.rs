//! Ahmed's colour marker (Ahmed et al., 2.2): a light cover with a head and a tail disc of different
//! colours, which identify the robot. It needs a colour camera, but few pixels.

use std::collections::BTreeMap;

use image::RgbImage;
use libm::hypot;

use super::{
    image_region::ImageRegion,
    marker::{Hue, Identifier, Marker},
};

/// Minimum difference between the channels of a coloured pixel.
const COLOURED: u8 = 50;
/// Minimum number of pixels of a blob; smaller ones are specks.
const MIN_PIXELS: usize = 12;
/// Maximum ratio of the numbers of pixels of head and tail, which are of equal size.
const MAX_SIZE_RATIO: usize = 2;
/// Distance between the centres of head and tail, divided by the diameter of a disc with the area
/// of the larger blob. It is nominally 1.25, and less where the marker is seen at an angle.
const APART: core::ops::Range<f64> = 0.6..2.2;
/// Minimum value of each channel on the marker's light background, between head and tail.
const LIGHT: u8 = 120;
/// Standard deviation of the coordinates of a disc's centre, in pixels.
const MIDDLE_NOISE_PX: f64 = 0.15;

/// Connected pixels of one colour.
struct Blob {
    hue: Hue,
    pixels: usize,
    middle: [f64; 2],
}

/// The colour markers in a region of a picture. The result may include pairs of blobs that are not
/// markers; [`locate`](super::locate) refuses those with a wrong size.
pub fn detect_colours(picture: &RgbImage, region: ImageRegion) -> Vec<Marker> {
    let blobs = blobs(picture, region);
    let mut markers = Vec::new();
    for head in &blobs {
        for tail in blobs.iter().filter(|tail| tail.hue != head.hue) {
            if are_pair(head, tail, picture) {
                markers.push(Marker {
                    identifier: Identifier::Colours { head: head.hue, tail: tail.hue },
                    points: vec![head.middle, tail.middle],
                    noise_px: MIDDLE_NOISE_PX,
                });
            }
        }
    }
    markers
}

fn are_pair(head: &Blob, tail: &Blob, picture: &RgbImage) -> bool {
    let (less, more) = (head.pixels.min(tail.pixels), head.pixels.max(tail.pixels));
    let ([x, y], [tail_x, tail_y]) = (head.middle, tail.middle);
    let diameter = libm::sqrt(more as f64 * 4.0 / core::f64::consts::PI);
    let is_light = || {
        let between = [(x + tail_x) / 2.0, (y + tail_y) / 2.0].map(|it| it.round() as u32);
        let pixel = picture.get_pixel_checked(between[0], between[1]);
        pixel.is_some_and(|pixel| pixel.0.iter().all(|&channel| channel >= LIGHT))
    };
    more <= MAX_SIZE_RATIO * less
        && APART.contains(&(hypot(x - tail_x, y - tail_y) / diameter))
        && is_light()
}

fn blobs(picture: &RgbImage, region: ImageRegion) -> Vec<Blob> {
    let mut rest: BTreeMap<(u32, u32), Hue> = BTreeMap::new();
    for row in region.top..region.top + region.height {
        for column in region.left..region.left + region.width {
            if let Some(hue) = hue(picture.get_pixel(column, row).0) {
                rest.insert((row, column), hue);
            }
        }
    }
    let mut blobs = Vec::new();
    while let Some((first, hue)) = rest.pop_first() {
        let mut pixels = vec![first];
        let mut next = 0;
        while let Some(&(row, column)) = pixels.get(next) {
            next += 1;
            let beside = [
                (row, column + 1),
                (row + 1, column),
                (row, column.wrapping_sub(1)),
                (row.wrapping_sub(1), column),
            ];
            for pixel in beside {
                if rest.get(&pixel) == Some(&hue) {
                    rest.remove(&pixel);
                    pixels.push(pixel);
                }
            }
        }
        if pixels.len() >= MIN_PIXELS {
            let middle = middle(picture, &pixels);
            blobs.push(Blob { hue, pixels: pixels.len(), middle });
        }
    }
    blobs
}

/// The centre of a blob. Its rim is faint and has less weight.
fn middle(picture: &RgbImage, pixels: &[(u32, u32)]) -> [f64; 2] {
    let mut sums = [0.0; 3];
    for &(row, column) in pixels {
        let weight = f64::from(colourfulness(picture.get_pixel(column, row).0));
        sums[0] += weight * f64::from(column);
        sums[1] += weight * f64::from(row);
        sums[2] += weight;
    }
    [sums[0] / sums[2], sums[1] / sums[2]]
}

fn colourfulness(channels: [u8; 3]) -> u8 {
    let (least, most) = range(channels);
    most - least
}

fn range([red, green, blue]: [u8; 3]) -> (u8, u8) {
    (red.min(green).min(blue), red.max(green).max(blue))
}

/// The nearest of the six colours; `None` for grey.
fn hue([red, green, blue]: [u8; 3]) -> Option<Hue> {
    let (least, most) = range([red, green, blue]);
    if most - least < COLOURED {
        return None;
    }
    // A channel is lit if its value is above the middle of the pixel's range.
    let is_lit = |channel: u8| channel - least > (most - least) / 2;
    Some(match [is_lit(red), is_lit(green), is_lit(blue)] {
        [true, false, false] => Hue::Red,
        [true, true, false] => Hue::Yellow,
        [false, true, false] => Hue::Green,
        [false, true, true] => Hue::Cyan,
        [false, false, true] => Hue::Blue,
        _ => Hue::Magenta,
    })
}
