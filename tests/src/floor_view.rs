//! Renders the view of a grey camera near the floor, in `f64` and from the geometry alone.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Columns and lines of an image.
pub const SIZE: (usize, usize) = (320, 240);

/// A level camera over a flat floor. Objects stand upright and fill a column up to the top.
#[derive(Clone, Copy, Debug)]
pub struct FloorView {
    /// Focal length in pixels.
    pub focal: f64,
    /// Lines from the bottom of the image up to the horizon.
    pub horizon: f64,
    /// Height of the camera above the floor in millimetres.
    pub height: f64,
}

/// Disturbances of the picture.
#[derive(Clone, Copy, Debug)]
pub struct Spoils {
    /// Maximum noise of a pixel in grey levels, in both directions.
    pub noise: u8,
    /// Difference of the light between the left and right side of the image, in grey levels.
    pub gradient: f64,
    /// Difference between neighbouring floor tiles, in grey levels; they are 8 cm wide.
    pub tiles: f64,
    /// Seed of the noise.
    pub seed: u64,
}

impl FloorView {
    /// The camera of the tests: a field of view of 90 degrees, 15 cm above the floor. Its horizon
    /// is where the distances in Ahmed's table 1 tend to infinity.
    pub const USUAL: Self = Self { focal: 160.0, horizon: 144.0, height: 150.0 };

    /// Offset to the left of an object in a column, per unit of depth.
    pub fn left(&self, column: usize) -> f64 {
        (159.5 - column as f64) / self.focal
    }

    /// Lines of floor below an object at some depth (millimetres along the optical axis).
    pub fn lines(&self, depth: f64) -> f64 {
        (self.horizon - self.focal * self.height / depth).max(0.0)
    }

    /// The image of objects at the given depth in each column, on a floor of grey 140.
    pub fn render(&self, object: u8, depth: impl Fn(usize) -> f64, spoils: Spoils) -> Vec<u8> {
        let mut random = ChaCha8Rng::seed_from_u64(spoils.seed);
        let (columns, lines) = SIZE;
        let mut image = Vec::new();
        for line in 0..lines {
            for column in 0..columns {
                // At the centre of the pixel.
                let below = self.horizon - (lines - line) as f64 + 0.5;
                let floor = self.focal * self.height / below;
                let surface = if below > 0.0 && floor < depth(column) {
                    self.floor(floor, floor * self.left(column), spoils)
                } else {
                    f64::from(object)
                };
                let light = spoils.gradient * (column as f64 / columns as f64 - 0.5);
                let noise = i16::from(spoils.noise);
                let noise = f64::from(random.random_range(-noise..=noise));
                image.push((surface + light + noise).clamp(0.0, 255.0) as u8);
            }
        }
        image
    }

    /// The grey level of the floor at a point.
    fn floor(&self, x: f64, y: f64, spoils: Spoils) -> f64 {
        const TILE: f64 = 80.0;
        let odd = ((x / TILE).floor() + (y / TILE).floor()).rem_euclid(2.0);
        140.0 + spoils.tiles * odd
    }
}
