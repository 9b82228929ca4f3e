//! Resamples a line of a tilted camera's frame to the columns of a level camera at the same place.

use libm::roundf;

use super::{
    camera::{Ray, Rays},
    validity::Validity,
};

/// Distance between pixels whose rays are computed exactly.
const STRIDE: usize = 32;

/// Fractional bits of rays and of positions in a line.
const RAY_BITS: u32 = 14;
const RAY_ONE: i32 = 1 << RAY_BITS;

/// The readings of a level camera at a certain height: for each column, the depth of the pixel
/// nearest to the height, and how far it is from the height.
pub(super) struct LevelRow<'b> {
    /// Depths in millimetres; 0 if there is none.
    pub(super) readings: &'b mut [u16],
    /// Vertical distance of each reading from the height, in millimetres. A pixel replaces a
    /// reading only if its distance is smaller.
    pub(super) misses: &'b mut [u16],
}

impl LevelRow<'_> {
    /// Compares the pixels of a line with the height `below` millimetres below the camera, and
    /// keeps those nearest to it. Skips pixels that are farther than `tolerance` from it. Rays are
    /// computed for every 32nd pixel and interpolated in between, with an error below a fifth of a
    /// pixel.
    pub(super) fn hold(
        &mut self,
        (rays, row): (&Rays, u16),
        depths: &[u16],
        (below, tolerance): (i32, i32),
        validity: &Validity,
    ) {
        let band = (below.saturating_sub(tolerance), below.saturating_add(tolerance));
        let last = depths.len().saturating_sub(1);
        let mut start = Knot::new(rays, 0, row);
        for pixel in (0..last).step_by(STRIDE).map(|pixel| (pixel + STRIDE).min(last)) {
            let end = Knot::new(rays, pixel, row);
            if let (Some(start), Some(end)) = (&start, &end)
                && start.may_meet(end, band, validity)
                && let Some(walk) = Walk::between(start, end, pixel == last)
            {
                self.follow(walk, depths, below, validity);
            }
            start = end;
        }
    }

    /// Compares the pixels of a walk, and keeps those that are nearest to the height.
    fn follow(&mut self, mut walk: Walk, depths: &[u16], below: i32, validity: &Validity) {
        let beyond = walk.beyond.min(self.readings.len()).min(self.misses.len());
        let columns = walk.first..beyond;
        let Some(readings) = self.readings.get_mut(columns.clone()) else { return };
        let Some(misses) = self.misses.get_mut(columns) else { return };
        for (reading, miss) in readings.iter_mut().zip(misses) {
            let depth = depths.get((walk.pixel.here >> RAY_BITS) as usize).map_or(0, |&it| it);
            let off = ((i32::from(depth) * walk.down.here) >> RAY_BITS).abs_diff(below);
            if off < u32::from(*miss) && validity.counts(depth) {
                *miss = off as u16;
                let ahead = (i32::from(depth) * walk.forward.here + RAY_ONE / 2) >> RAY_BITS;
                *reading = ahead.clamp(0, i32::from(u16::MAX)) as u16;
            }
            walk.pixel.advance();
            walk.forward.advance();
            walk.down.advance();
        }
    }
}

/// A pixel of a line with its exact ray.
struct Knot {
    pixel: f32,
    /// The level camera's column that sees the points of this ray.
    column: f32,
    ray: Ray,
}

impl Knot {
    fn new(rays: &Rays, pixel: usize, row: u16) -> Option<Self> {
        let pixel = pixel as f32;
        let ray = rays.at(pixel, f32::from(row))?;
        // Steeper rays meet heights only right below the camera, and would overflow the integers.
        let is_flat = ray.forward > 0.1 && ray.forward < 1.9 && ray.down.abs() < 1.9;
        is_flat.then(|| Self { pixel, column: rays.level_column(&ray), ray })
    }

    /// Whether a valid pixel between two knots can lie in a height band below the camera.
    fn may_meet(&self, other: &Self, band: (i32, i32), validity: &Validity) -> bool {
        let (upper, lower) = (self.ray.down.min(other.ray.down), self.ray.down.max(other.ray.down));
        let (near, far) = (f32::from(validity.nearest), f32::from(validity.farthest));
        let (highest, lowest) = ((upper * near).min(upper * far), (lower * near).max(lower * far));
        lowest >= band.0 as f32 - 1.0 && highest <= band.1 as f32 + 1.0
    }
}

/// The level camera's columns from one [`Knot`] to the next, and the values that are interpolated
/// for each of them: the pixel of the line, and the forward and down components of its ray.
struct Walk {
    first: usize,
    beyond: usize,
    pixel: Ramp,
    forward: Ramp,
    down: Ramp,
}

/// A value that changes linearly from column to column, in 1/16,384.
struct Ramp {
    here: i32,
    step: i32,
}

impl Ramp {
    fn advance(&mut self) {
        self.here = self.here.wrapping_add(self.step);
    }
}

impl Walk {
    /// The walk from one knot to the next. The next knot's own column is included only if it is the
    /// last. `None` if the columns do not increase.
    fn between(start: &Knot, end: &Knot, is_last: bool) -> Option<Self> {
        let span = end.column - start.column;
        let first = roundf(start.column).max(0.0);
        let beyond = roundf(end.column) + if is_last { 1.0 } else { 0.0 };
        let ramp = |from: f32, to: f32| {
            let (step, one) = ((to - from) / span, RAY_ONE as f32);
            let here = from + step * (first - start.column);
            Ramp { here: roundf(here * one) as i32, step: roundf(step * one) as i32 }
        };
        (span > 0.1 && beyond > first).then(|| Self {
            first: first as usize,
            beyond: beyond as usize,
            pixel: ramp(start.pixel + 0.5, end.pixel + 0.5),
            forward: ramp(start.ray.forward, end.ray.forward),
            down: ramp(start.ray.down, end.ray.down),
        })
    }
}
