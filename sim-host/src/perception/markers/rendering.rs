//! Renders pictures of markers under a ceiling camera for tests: supersampled, blurred, noisy.

use image::{Rgb, RgbImage};
use libm::sincos;
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector2};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use super::{image_region::ImageRegion, locate::on_plane, marker::Hue};
use crate::camera::{Intrinsics, Lens, Picture};

/// The codes of the family's first tags, row by row from the upper left, as published by its
/// authors.
const TAGS: [u64; 12] = [
    0xd_5d62_8584,
    0xd_97f1_8b49,
    0xd_d280_910e,
    0xe_479e_9c98,
    0xe_bcbc_a822,
    0xf_31da_b3ac,
    0x0_56a5_d085,
    0x1_0652_e1d4,
    0x2_2b1d_fead,
    0x2_65ad_0472,
    0x3_4fe9_1b86,
    0x3_ff96_2cd5,
];
/// Samples per pixel in each direction.
const SAMPLES: usize = 4;
const FLOOR: [f64; 3] = [140.0, 135.0, 125.0];
/// Number of precomputed noise values: a prime, so that no two rows have the same sequence.
const NOISES: usize = 99_991;
/// Standard deviation of the blur, in pixels.
const BLUR_PX: f64 = 0.7;

/// The pattern of a plate.
#[derive(Clone, Copy, Debug)]
pub(in crate::perception) enum Paint {
    /// A tag by number, with a margin of one of its eight modules.
    Tag(usize),
    /// A head and a tail, each a disc, on a light square.
    Colours(Hue, Hue),
}

/// A square plate with a marker; level unless `rise_m` is non-zero.
#[derive(Clone, Copy, Debug)]
pub(in crate::perception) struct Plate {
    pub(in crate::perception) paint: Paint,
    /// Side of the marker without its margin, in metres.
    pub(in crate::perception) side_m: f64,
    pub(in crate::perception) height_m: f64,
    /// Position of the centre in `map` in metres, and the heading in radians.
    pub(in crate::perception) pose: [f64; 3],
    /// Height of the front edge above the centre, in metres.
    pub(in crate::perception) rise_m: f64,
}

impl Plate {
    pub(in crate::perception) fn level(
        paint: Paint,
        side_m: f64,
        height_m: f64,
        pose: [f64; 3],
    ) -> Self {
        Self { paint, side_m, height_m, pose, rise_m: 0.0 }
    }

    /// The colour at a point, given by its distances ahead and to the left of the centre as multiples of
    /// `side_m`; `None` outside the plate.
    fn colour(&self, ahead: f64, left: f64) -> Option<[f64; 3]> {
        let within = |half: f64| ahead.abs() <= half && left.abs() <= half;
        match self.paint {
            Paint::Tag(number) => {
                let module = |at: f64| (at * 8.0).floor() as i32;
                let (row, column) = (module(0.5 - ahead), module(0.5 - left));
                let is_code = (1..7).contains(&row) && (1..7).contains(&column);
                let bit = 35 - ((row - 1) * 6 + column - 1);
                let is_light = if is_code { TAGS[number] >> bit & 1 == 1 } else { !within(0.5) };
                within(0.625).then_some(if is_light { [225.0; 3] } else { [30.0; 3] })
            }
            Paint::Colours(head, tail) => {
                let disc = |middle: f64| (ahead - middle).hypot(left) <= 0.2;
                let hue = [(0.25, head), (-0.25, tail)].into_iter().find(|it| disc(it.0));
                within(0.5).then_some(hue.map_or([225.0; 3], |(_, hue)| paint(hue)))
            }
        }
    }

    /// The corners of a concentric square whose side is `sides` times `side_m`.
    fn corners(&self, sides: f64) -> impl Iterator<Item = Point3<f64>> {
        let (sine, cosine) = sincos(self.pose[2]);
        let (reach, [x, y, _]) = (self.side_m * sides / 2.0, self.pose);
        [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]].into_iter().map(move |[a, b]| {
            let (a, b) = (a * reach, b * reach);
            Point3::new(x + cosine * a - sine * b, y + sine * a + cosine * b, self.height_m)
        })
    }
}

fn paint(hue: Hue) -> [f64; 3] {
    let lit = match hue {
        Hue::Red => [1, 0, 0],
        Hue::Yellow => [1, 1, 0],
        Hue::Green => [0, 1, 0],
        Hue::Cyan => [0, 1, 1],
        Hue::Blue => [0, 0, 1],
        Hue::Magenta => [1, 0, 1],
    };
    lit.map(|lit| if lit == 1 { 200.0 } else { 50.0 })
}

/// The colour sensor of a D435 at a position in `map`, tilted by an angle from straight down towards its
/// heading.
pub(in crate::perception) fn ceiling_camera(
    position_m: [f64; 3],
    tilt_rad: f64,
    heading_rad: f64,
) -> Lens {
    // The optical frame for looking straight down, with the top of the picture ahead.
    let down = Matrix3::new(0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0);
    let turn = Rotation3::from_euler_angles(0.0, -tilt_rad, heading_rad);
    let turn = turn * Rotation3::from_matrix_unchecked(down);
    let [x, y, z] = position_m;
    let place = Translation3::new(x, y, z);
    let pose = Isometry3::from_parts(place, UnitQuaternion::from_rotation_matrix(&turn));
    Lens::new(Intrinsics::pinhole(1280, 720, 69f64.to_radians()), pose).unwrap()
}

/// Renders plates, lower ones first, with noise of the given standard deviation in each channel.
pub(in crate::perception) fn render(
    lens: &Lens,
    plates: &[Plate],
    noise: f64,
    seed: u64,
) -> RgbImage {
    let (width, height) = (lens.intrinsics().width, lens.intrinsics().height);
    let mut canvas = vec![FLOOR.map(|it| it as f32); (width * height) as usize];
    for plate in plates {
        draw(lens, plate, &mut canvas);
    }
    blur(&mut canvas, width as usize);
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    let normal = Normal::new(0.0, noise as f32).unwrap();
    // Drawing one random number for each pixel would dominate the run time.
    let throws: Vec<f32> = normal.sample_iter(&mut dice).take(NOISES).collect();
    let mut throw = throws.iter().cycle();
    RgbImage::from_fn(width, height, |column, row| {
        let colour = canvas[(row * width + column) as usize];
        Rgb(colour.map(|it| (it + throw.next().unwrap()).round() as u8))
    })
}

/// Renders like [`render`], for a grey camera.
pub(in crate::perception) fn render_grey(
    lens: &Lens,
    plates: &[Plate],
    noise: f64,
    seed: u64,
) -> Picture {
    Picture::Grey(image::imageops::grayscale(&render(lens, plates, noise, seed)))
}

fn draw(lens: &Lens, plate: &Plate, canvas: &mut [[f32; 3]]) {
    let Some(region) = region(lens, plate) else { return };
    let (sine, cosine) = sincos(plate.pose[2]);
    for row in region.top..region.top + region.height {
        for column in region.left..region.left + region.width {
            let (mut sum, mut covered) = ([0.0; 3], 0.0);
            for sample in 0..SAMPLES * SAMPLES {
                let at = |index: usize| (index as f64 + 0.5) / SAMPLES as f64 - 0.5;
                let pixel = [
                    f64::from(column) + at(sample % SAMPLES),
                    f64::from(row) + at(sample / SAMPLES),
                ];
                let Some([ahead, left]) = meet(lens, plate, pixel, [sine, cosine]) else {
                    continue;
                };
                if let Some(colour) = plate.colour(ahead / plate.side_m, left / plate.side_m) {
                    covered += 1.0;
                    (0..3).for_each(|channel| sum[channel] += colour[channel]);
                }
            }
            let samples = (SAMPLES * SAMPLES) as f64;
            let pixel = &mut canvas[(row * lens.intrinsics().width + column) as usize];
            for channel in 0..3 {
                let rest = f64::from(pixel[channel]) * (samples - covered);
                pixel[channel] = ((sum[channel] + rest) / samples) as f32;
            }
        }
    }
}

/// The point where a pixel's ray meets a plate, in metres ahead and to the left of its centre.
fn meet(lens: &Lens, plate: &Plate, pixel: [f64; 2], [sine, cosine]: [f64; 2]) -> Option<[f64; 2]> {
    // Height gained per metre of distance ahead.
    let slope = plate.rise_m / (plate.side_m / 2.0);
    let mut height = plate.height_m;
    let mut met = [0.0; 2];
    for _ in 0..if slope == 0.0 { 1 } else { 8 } {
        let place = on_plane(lens, pixel, height)? - Vector2::new(plate.pose[0], plate.pose[1]);
        met = [cosine * place.x + sine * place.y, cosine * place.y - sine * place.x];
        height = plate.height_m + slope * met[0];
    }
    // Converts the horizontal distance to the distance along the slope.
    Some([met[0] * (1.0 + slope * slope).sqrt(), met[1]])
}

fn region(lens: &Lens, plate: &Plate) -> Option<ImageRegion> {
    let corners: Option<Vec<[f64; 2]>> =
        plate.corners(1.4).map(|corner| lens.project(&corner)).collect();
    let corners = corners?;
    let bound = |axis: usize, size: u32| {
        let values = || corners.iter().map(|corner| corner[axis]);
        let clamped = |at: f64| at.clamp(0.0, f64::from(size)) as u32;
        let first = clamped(values().fold(f64::INFINITY, f64::min));
        (first, clamped(values().fold(0.0, f64::max).ceil()).saturating_sub(first))
    };
    let (left, width) = bound(0, lens.intrinsics().width);
    let (top, height) = bound(1, lens.intrinsics().height);
    Some(ImageRegion { left, top, width, height })
}

fn blur(canvas: &mut [[f32; 3]], width: usize) {
    let weight = |step: i32| (-f64::from(step * step) / (2.0 * BLUR_PX * BLUR_PX)).exp() as f32;
    let weights = [-2, -1, 0, 1, 2].map(weight);
    let sum: f32 = weights.iter().sum();
    for step in [1, width] {
        let from = canvas.to_vec();
        for index in 2 * step..canvas.len() - 2 * step {
            let (before, after) = (from[index - 2 * step], from[index + 2 * step]);
            if before == after && before == from[index - step] && before == from[index + step] {
                continue;
            }
            canvas[index] = [0, 1, 2].map(|channel| {
                let tap = |at: usize| weights[at] * from[index + at * step - 2 * step][channel];
                (tap(0) + tap(1) + tap(2) + tap(3) + tap(4)) / sum
            });
        }
    }
}
