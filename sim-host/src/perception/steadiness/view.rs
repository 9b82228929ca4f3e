//! What a camera sees of the room that does not move, on a coarse grid of pixels.
//!
//! A plane in the optical frame is `n . X = 1`. A pixel with the ray `r` (at a depth of one metre) sees it
//! at the inverse depth `1 / d = n . r`: linear in the pixel, and a stereo camera's noise of it is the
//! same at all depths. If the camera moves by the small translation `t` and rotation `w`, it sees the
//! plane at `n' = n + n x w + n (n . t)`, so that the inverse depth changes by
//! `(r x n) . w + (n . r) (n . t)`. These are the equations of a least squares problem, in which people
//! and moved furniture are outliers (Tukey's biweight).

use nalgebra::{Isometry3, Matrix3, Matrix6, Vector3, Vector6};
use ubimap_protocol::time::{Duration, Instant};

use super::motion::{Motion, motion, prior, transform};
use crate::camera::{DepthNoise, Intrinsics};

/// Approximate number of columns of the grid.
const COLUMNS: u32 = 80;
/// Number of images from which a view is learnt, the interval between them, and the minimum number with a
/// depth at a pixel.
const IMAGES: usize = 15;
const INTERVAL: Duration = Duration::from_millis(280);
const MEASURED: usize = 8;
/// Interval at which a view is improved.
const IMPROVED: Duration = Duration::from_millis(950);
/// Number of improvements after which a view is settled.
const SETTLED: u32 = 60;
/// Maximum number of depths in the mean of a pixel.
const MEAN_OF: u32 = 100;
/// Number of improvements after which something else becomes part of the view.
const STAYS: u32 = 30;
/// Half the sides of the squares of pixels that make a plane, the greatest that is flat first: noise of a
/// plane's normal would pass for information on directions that the view can't tell.
const AROUND: [usize; 2] = [4, 2];
/// Minimum part of the pixels of a square that are measured.
const PLANE_OF: f64 = 0.7;
/// Number of improvements after which the planes are computed again.
const AGAIN: u32 = 5;
/// Maximum mean square error of a plane, in variances of the noise of the mean of so many depths.
const FLAT: f64 = 2.0;
const FLAT_OF: u32 = 15;
/// Differences in standard deviations: of depths that belong to a pixel's mean, of samples that are
/// explained by an alignment, and of those that are clearly behind the view.
const SAME: f64 = 4.0;
const EXPLAINED: f64 = 3.0;
/// The outlier limit in each step of the alignment, in standard deviations.
const LIMITS: [f64; 8] = [12.0, 8.0, 6.0, 4.5, 4.0, 4.0, 4.0, 4.0];
/// Minimum number of planes of an alignment.
const LEAST_PLANES: usize = 200;

/// The view of one camera.
#[derive(Clone, Debug)]
pub struct View {
    noise: DepthNoise,
    columns: usize,
    /// The rays of the grid's pixels, row by row, and their indices in an image.
    rays: Vec<Vector3<f64>>,
    pixels: Vec<usize>,
    /// The first images, until the view is learnt.
    first: Vec<Vec<u16>>,
    samples: Vec<Sample>,
    planes: Vec<Plane>,
    due: Instant,
    /// Improvements since the first images.
    improved: u32,
}

/// The mean inverse depth of a pixel in 1/m, and one that may replace it; each with its number of depths.
#[derive(Clone, Copy, Debug, Default)]
struct Sample {
    mean: f64,
    count: u32,
    other: f64,
    others: u32,
}

/// The plane that a pixel sees.
#[derive(Clone, Copy, Debug)]
struct Plane {
    sample: usize,
    normal: Vector3<f64>,
    /// Standard deviation of one inverse depth.
    sigma: f64,
}

/// A depth image against a view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Aligned {
    /// The motion since the view was learnt.
    pub pose: Isometry3<f64>,
    /// The same, relative to the pose from which the alignment began.
    pub motion: Motion,
    /// The same by plain means, as those of the view are: where noise is skewed, means differ from what Tukey's
    /// biweight finds, by as much in every image.
    pub mean: Motion,
    /// The part of the measured planes that it explains, and the part that is clearly farther than
    /// it should be.
    pub explained: f64,
    pub farther: f64,
}

impl View {
    /// The view of a depth sensor that has not seen anything.
    pub fn new(intrinsics: &Intrinsics, noise: DepthNoise) -> Self {
        let Intrinsics { width, height, .. } = *intrinsics;
        let step = (width / COLUMNS).max(1) as usize;
        let along = |size: u32| (step as u32 / 2..size).step_by(step);
        let at = along(height).flat_map(|row| along(width).map(move |column| (column, row)));
        let at: Vec<(u32, u32)> = at.collect();
        let ray =
            |&(column, row): &(u32, u32)| intrinsics.direction([f64::from(column), f64::from(row)]);
        Self {
            noise,
            columns: along(width).count(),
            rays: at.iter().map(ray).collect(),
            pixels: at.iter().map(|&(column, row)| (row * width + column) as usize).collect(),
            first: Vec::new(),
            samples: vec![Sample::default(); at.len()],
            planes: Vec::new(),
            due: Instant(0),
            improved: 0,
        }
    }

    /// Whether the view has been learnt.
    pub fn is_learnt(&self) -> bool {
        !self.planes.is_empty()
    }

    /// Whether so many images were learnt that their noise hardly matters.
    pub(super) fn is_settled(&self) -> bool {
        self.is_learnt() && self.improved >= SETTLED
    }

    /// The number of images in the mean of a pixel.
    pub(super) fn images(&self) -> u32 {
        (IMAGES as u32).saturating_add(self.improved).min(MEAN_OF)
    }

    /// The depths at the pixels of the grid, 0 where `is_hidden` says of a ray in the optical frame that
    /// something is in its way that does not belong to the room.
    pub(super) fn sample(
        &self,
        depths: &[u16],
        is_hidden: impl Fn(&Vector3<f64>) -> bool,
    ) -> Vec<u16> {
        let depth = |(&pixel, ray): (&usize, &Vector3<f64>)| {
            depths.get(pixel).copied().filter(|_| !is_hidden(ray)).unwrap_or(0)
        };
        self.pixels.iter().zip(&self.rays).map(depth).collect()
    }

    /// Learns from the [`sample`](Self::sample) of an image of a camera that stands still.
    pub(super) fn learn(&mut self, depths: &[u16], captured: Instant) {
        if captured < self.due {
            return;
        }
        if self.is_learnt() {
            self.due = captured + IMPROVED;
            self.improve(depths);
            self.improved = self.improved.saturating_add(1);
            if !self.improved.is_multiple_of(AGAIN) {
                return;
            }
        } else {
            self.due = captured + INTERVAL;
            self.first.push(depths.to_vec());
            if self.first.len() < IMAGES {
                return;
            }
            self.settle();
            self.improved = 0;
        }
        self.planes = (0..self.samples.len()).filter_map(|sample| self.plane(sample)).collect();
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.first.clear();
        self.samples.fill(Sample::default());
        self.planes.clear();
        self.improved = 0;
    }

    /// The motion of the camera since the view was learnt, if it explains the [`sample`](Self::sample) of an
    /// image; the search begins at `from`. `None` if there is too little to go by.
    pub(super) fn align(&self, depths: &[u16], from: &Isometry3<f64>) -> Option<Aligned> {
        let seen = self.planes.iter().filter_map(|plane| {
            let depth = depths[plane.sample];
            (depth > 0).then(|| (plane, self.rays[plane.sample], 1000.0 / f64::from(depth)))
        });
        let seen: Vec<(&Plane, Vector3<f64>, f64)> = seen.collect();
        if seen.len() < LEAST_PLANES {
            return None;
        }
        let step = |pose: &Isometry3<f64>, weight: &dyn Fn(f64) -> f64| {
            let (mut information, mut gradient) = (Matrix6::zeros(), Vector6::zeros());
            for (plane, ray, inverse) in &seen {
                let (normal, expected) = plane.seen_from(pose, ray);
                let error = (inverse - expected) / plane.sigma;
                let weight = weight(error);
                if weight == 0.0 {
                    continue;
                }
                let (shift, turn) = (normal * expected, ray.cross(&normal));
                let slope = Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z);
                let slope = slope / plane.sigma;
                information += slope * slope.transpose() * weight;
                gradient += slope * (weight * error);
            }
            let way = motion(&from.inv_mul(pose));
            let step = (information + prior()).try_inverse()? * (gradient - prior() * way);
            let pose = pose * transform(&step);
            Some((pose, Motion::new(&motion(&from.inv_mul(&pose)), information)))
        };
        let (mut pose, mut told) = (*from, Motion::UNKNOWN);
        for limit in LIMITS {
            (pose, told) = step(&pose, &|error| {
                let ratio = (error / limit).clamp(-1.0, 1.0);
                (1.0 - ratio * ratio).powi(2)
            })?;
        }
        let (_, mean) = step(&pose, &|error| if error.abs() < SAME { 1.0 } else { 0.0 })?;
        let errors = seen
            .iter()
            .map(|(plane, ray, inverse)| (inverse - plane.seen_from(&pose, ray).1) / plane.sigma);
        let part = |is: fn(f64) -> bool| {
            errors.clone().filter(|&error| is(error)).count() as f64 / seen.len() as f64
        };
        Some(Aligned {
            pose,
            motion: told,
            mean,
            explained: part(|error| error.abs() < EXPLAINED),
            farther: part(|error| error < -SAME),
        })
    }

    /// Ends the initial learning: means without what only passed by.
    fn settle(&mut self) {
        let images = std::mem::take(&mut self.first);
        for (index, sample) in self.samples.iter_mut().enumerate() {
            let mut seen: Vec<u16> = images.iter().map(|image| image[index]).collect();
            seen.retain(|depth| *depth > 0);
            *sample = Sample::default();
            if seen.len() < MEASURED {
                continue;
            }
            let middle = seen.len() / 2;
            let median = 1000.0 / f64::from(*seen.select_nth_unstable(middle).1);
            let reach = SAME * sigma(&self.noise, median);
            for inverse in seen.iter().map(|&depth| 1000.0 / f64::from(depth)) {
                if (inverse - median).abs() < reach {
                    sample.add(inverse);
                }
            }
        }
    }

    fn improve(&mut self, depths: &[u16]) {
        for (sample, &depth) in self.samples.iter_mut().zip(depths) {
            if depth > 0 {
                let inverse = 1000.0 / f64::from(depth);
                sample.improve(inverse, SAME * sigma(&self.noise, inverse));
            }
        }
    }

    /// The plane about a pixel, if its surroundings are flat.
    fn plane(&self, sample: usize) -> Option<Plane> {
        if self.samples[sample].count == 0 {
            return None;
        }
        AROUND.into_iter().find_map(|around| self.plane_within(sample, around))
    }

    fn plane_within(&self, sample: usize, around: usize) -> Option<Plane> {
        let (column, row) = (sample % self.columns, sample / self.columns);
        let rows = self.samples.len() / self.columns;
        if column < around
            || row < around
            || column + around >= self.columns
            || row + around >= rows
        {
            return None;
        }
        let side = 2 * around + 1;
        let near = (row - around..=row + around).flat_map(|row| {
            let first = row * self.columns + column - around;
            first..first + side
        });
        let near = || near.clone().filter(|&index| self.samples[index].count > 0);
        let (mut squares, mut sums, mut count) = (Matrix3::zeros(), Vector3::zeros(), 0);
        for index in near() {
            let ray = self.rays[index];
            squares += ray * ray.transpose();
            sums += ray * self.samples[index].mean;
            count += 1;
        }
        if f64::from(count) < PLANE_OF * (side * side) as f64 {
            return None;
        }
        let normal = squares.try_inverse()? * sums;
        let sigma = sigma(&self.noise, self.samples[sample].mean);
        let error = |index: usize| {
            let Sample { mean, count, .. } = self.samples[index];
            let error = (mean - normal.dot(&self.rays[index])) / sigma;
            error * error * f64::from(count.min(FLAT_OF))
        };
        // Three parameters were fitted.
        let mean_square = near().map(error).sum::<f64>() / f64::from(count - 3);
        (mean_square < FLAT).then_some(Plane { sample, normal, sigma })
    }
}

impl Sample {
    fn add(&mut self, inverse: f64) {
        self.count = (self.count + 1).min(MEAN_OF);
        self.mean += (inverse - self.mean) / f64::from(self.count);
    }

    fn improve(&mut self, inverse: f64, reach: f64) {
        if self.count > 0 && (inverse - self.mean).abs() < reach {
            self.others = self.others.saturating_sub(1);
            if self.count < MEAN_OF {
                self.add(inverse);
            }
            return;
        }
        if self.others == 0 || (inverse - self.other).abs() >= reach {
            (self.other, self.others) = (inverse, 0);
        }
        self.others += 1;
        self.other += (inverse - self.other) / f64::from(self.others);
        if self.others >= STAYS {
            *self = Self { mean: self.other, count: self.others, ..Self::default() };
        }
    }
}

impl Plane {
    /// The plane in the optical frame of a camera that has moved, and its inverse depth on a ray.
    fn seen_from(&self, pose: &Isometry3<f64>, ray: &Vector3<f64>) -> (Vector3<f64>, f64) {
        let turned = pose.rotation.inverse() * self.normal;
        let normal = turned / (1.0 - self.normal.dot(&pose.translation.vector));
        (normal, normal.dot(ray))
    }
}

/// The standard deviation of an inverse depth.
fn sigma(noise: &DepthNoise, inverse: f64) -> f64 {
    noise.sigma_m(1.0 / inverse) * inverse * inverse
}
