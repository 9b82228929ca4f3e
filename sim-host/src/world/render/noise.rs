//! What sensors add to what there is: a stereo camera's errors of depth, a picture's noise.
//!
//! The noise is thrown once, into a long field; each row of each frame reads it from a place of
//! its own. That costs a fraction of a throw for each pixel and is as random to the eye.

use image::{ImageBuffer, Luma};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::canvas::Canvas;
use crate::{camera::DepthImage, world::scenario::CameraConfig};

/// Throws of a field; a row of a frame is far shorter.
const LENGTH: usize = 1 << 18;

/// Parts of a pixel in which a D435 gives a disparity: five fractional bits.
const PARTS: f32 = 32.0;

/// A difference of disparity between two neighbouring pixels, in pixels, that no surface shows
/// which is not seen edge on: the edge of something.
const EDGE: f32 = 0.5;

/// Neighbouring pixels are matched by windows that overlap: how much of a throw they share.
const SHARED: [f32; 3] = [0.5, 0.707_106_77, 0.5];

/// Added to and taken from a number of less than 2^22, it rounds it to the nearest whole one.
const ROUND: f32 = 12_582_912.0;

/// A number's whole part is in the lower bits of its sum with this.
const WHOLE: f32 = 8_388_608.0;

/// The errors of a stereo camera's depth.
pub(super) struct DepthNoise {
    /// Disparity, in parts of a pixel, that a depth of one metre has.
    scale: f32,
    range: (f32, f32),
    /// What is added to a disparity, in parts of a pixel; infinite where there is no match.
    field: Vec<f32>,
}

impl DepthNoise {
    /// The noise of a sensor with this focal length in pixels. The deviation of a depth `z` is
    /// `z^2 * noise_px / (focal * baseline)`, as the maker states it (Intel, Best-known-methods
    /// for tuning RealSense D400 depth cameras): with a D435's 0.08 px at 337 px and 50 mm, 0.5 %
    /// of 1 m and 1.9 % of 4 m.
    pub(super) fn new(camera: &CameraConfig, focal: f64, dice: &mut ChaCha8Rng) -> Self {
        let config = &camera.depth;
        let deviation = config.noise_px as f32 * PARTS;
        let throws: Vec<f32> =
            (0..LENGTH + 2).map(|_| -> f32 { StandardNormal.sample(dice) }).collect();
        let field = throws.windows(3).map(|near| {
            let shared: f32 = near.iter().zip(SHARED).map(|(throw, part)| throw * part).sum();
            let is_lost = dice.random_range(0.0..1.0) < config.dropout;
            if is_lost { f32::INFINITY } else { shared * deviation }
        });
        Self {
            scale: (focal * config.baseline_m) as f32 * PARTS,
            range: (config.min_range_m as f32 * 1000.0, camera.range_m as f32 * 1000.0),
            field: field.collect(),
        }
    }

    /// The image that the sensor gives.
    ///
    /// Pixels whose surface the right imager does not see, because something nearer covers it
    /// there, have no depth: a shadow to the left of whatever stands out. Nor has every other
    /// pixel on an edge.
    pub(super) fn image(&self, canvas: &Canvas, width: usize, dice: &mut ChaCha8Rng) -> DepthImage {
        let height = canvas.depth.len() / width;
        let mut image = Vec::with_capacity(width * height);
        let mut above: Vec<f32> = Vec::new();
        let mut row = vec![0.0; width];
        let mut added = vec![0.0; width];
        for depths in canvas.depth.chunks_exact(width) {
            for (disparity, depth) in row.iter_mut().zip(depths) {
                *disparity = self.scale / depth;
            }
            if above.is_empty() {
                above.clone_from(&row);
            }
            let start = dice.random_range(0..LENGTH - width);
            added.copy_from_slice(&self.field[start..][..width]);
            lose_edges(&row, &above, &mut added);
            lose_shadows(&row, &mut added);
            let (nearest, farthest) = self.range;
            image.extend(row.iter().zip(&added).map(|(disparity, added)| {
                let parts = (disparity + added) + ROUND - ROUND;
                let millimetres = 1000.0 * self.scale / parts;
                if millimetres >= nearest && millimetres <= farthest {
                    (millimetres + WHOLE).to_bits() as u16
                } else {
                    0
                }
            }));
            std::mem::swap(&mut above, &mut row);
        }
        image_of(width, height, image)
    }
}

fn image_of(width: usize, height: usize, pixels: Vec<u16>) -> DepthImage {
    ImageBuffer::<Luma<u16>, _>::from_raw(width as u32, height as u32, pixels)
        .unwrap_or_else(|| DepthImage::new(0, 0))
}

/// On an edge, a match is found where the noise is below its mean only.
fn lose_edges(row: &[f32], above: &[f32], added: &mut [f32]) {
    let edge = EDGE * PARTS;
    let is_lost = |jump: f32, noise: f32| jump.abs() > edge && noise > 0.0;
    for ((here, above), added) in row.iter().zip(above).zip(added.iter_mut()) {
        let lost = is_lost(here - above, *added);
        *added = if lost { f32::INFINITY } else { *added };
    }
    for (pair, added) in row.windows(2).zip(added) {
        let lost = is_lost(pair[1] - pair[0], *added);
        *added = if lost { f32::INFINITY } else { *added };
    }
}

/// A pixel is seen by the right imager so many columns farther left as its disparity says; there
/// something to its right may come before it.
fn lose_shadows(row: &[f32], added: &mut [f32]) {
    let mut nearest = f32::INFINITY;
    for (column, (disparity, added)) in row.iter().zip(added).enumerate().rev() {
        let there = column as f32 * PARTS - disparity;
        if there > nearest {
            *added = f32::INFINITY;
        }
        nearest = nearest.min(there);
    }
}

/// The noise of a picture.
pub(super) struct PictureNoise {
    /// In grey levels, 128 more than it is.
    field: Vec<u8>,
}

impl PictureNoise {
    /// Noise of this standard deviation in grey levels.
    pub(super) fn new(deviation: f64, dice: &mut ChaCha8Rng) -> Self {
        let mut throw = || -> f64 { StandardNormal.sample(dice) };
        Self { field: (0..LENGTH).map(|_| (128.0 + deviation * throw()).round() as u8).collect() }
    }

    /// The bytes of a picture, of `stride` to a row, with noise.
    pub(super) fn add(&self, light: &[u8], stride: usize, dice: &mut ChaCha8Rng) -> Vec<u8> {
        let mut noisy = Vec::with_capacity(light.len());
        for row in light.chunks(stride) {
            let start = dice.random_range(0..LENGTH - stride);
            let field = &self.field[start..][..row.len()];
            noisy.extend(row.iter().zip(field).map(|(&light, &noise)| {
                (i16::from(light) + i16::from(noise) - 128).clamp(0, 255) as u8
            }));
        }
        noisy
    }
}
