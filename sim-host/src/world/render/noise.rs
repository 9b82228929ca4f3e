//! Sensor noise: disparity errors of a stereo camera, and noise of a picture.
//!
//! The noise is drawn once, into a long field, and each row of each frame reads it from a random
//! position. This costs far less than drawing it for each pixel, and looks as random.

use image::{ImageBuffer, Luma};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::canvas::Canvas;
use crate::{
    camera::DepthImage,
    world::{
        scenario::CameraConfig,
        stereo::{PARTS, Stereo},
    },
};

/// Number of values in a field; a row of a frame is far shorter.
const LENGTH: usize = 1 << 18;

/// Correlation of neighbouring pixels, whose matching windows overlap: weights of three adjacent values.
const SHARED: [f32; 3] = [0.5, 0.707_106_77, 0.5];

/// The noise of a stereo camera.
pub(super) struct StereoNoise {
    stereo: Stereo,
    /// Disparity errors in fractions of a pixel ([`PARTS`]); infinite for no match.
    field: Vec<f32>,
}

impl StereoNoise {
    /// The noise of a sensor with a focal length in pixels.
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
        let range = [config.min_range_m, camera.range_m];
        Self { stereo: Stereo::new(focal, config.baseline_m, range), field: field.collect() }
    }

    /// The depth image of the sensor.
    pub(super) fn image(&self, canvas: &Canvas, width: usize, dice: &mut ChaCha8Rng) -> DepthImage {
        let height = canvas.depth.len() / width;
        let mut image = Vec::with_capacity(width * height);
        let mut above: Vec<f32> = Vec::new();
        let mut row = vec![0.0; width];
        let mut added = vec![0.0; width];
        for depths in canvas.depth.chunks_exact(width) {
            self.stereo.disparities(depths, &mut row);
            if above.is_empty() {
                above.clone_from(&row);
            }
            let start = dice.random_range(0..LENGTH - width);
            added.copy_from_slice(&self.field[start..][..width]);
            self.stereo.measure(&row, &above, &mut added, &mut image);
            std::mem::swap(&mut above, &mut row);
        }
        image_of(width, height, image)
    }
}

fn image_of(width: usize, height: usize, pixels: Vec<u16>) -> DepthImage {
    ImageBuffer::<Luma<u16>, _>::from_raw(width as u32, height as u32, pixels)
        .unwrap_or_else(|| DepthImage::new(0, 0))
}

/// The noise of a picture.
pub(super) struct PictureNoise {
    /// Noise in grey levels, offset by 128.
    field: Vec<u8>,
}

impl PictureNoise {
    /// Noise with a standard deviation in grey levels.
    pub(super) fn new(deviation: f64, dice: &mut ChaCha8Rng) -> Self {
        let mut throw = || -> f64 { StandardNormal.sample(dice) };
        Self { field: (0..LENGTH).map(|_| (128.0 + deviation * throw()).round() as u8).collect() }
    }

    /// Adds noise to the bytes of a picture with `stride` bytes per row.
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
