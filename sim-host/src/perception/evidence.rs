//! The evidence of one depth image: for each cell the number of pixels that see its floor, an obstacle,
//! or a new object (one that is not in the background).
//!
//! Most pixels of a fixed camera see their background. [`Evidence::fuse`] therefore starts with the
//! totals of the background, compares pixels with their windows, 64 at a time, and corrects the
//! counts for the pixels outside. [`Evidence::scatter`] computes the same evidence pixel by pixel,
//! as an oracle in tests and a baseline in benchmarks.

use crate::camera::LAYERS;

use super::{
    background::Background,
    changes::{Changes, WORD, ones},
    ray_table::{Allowance, RayTable, Zone},
};

/// A layer of a height profile is 2^7 = 128 mm high.
pub(super) const LAYER_SHIFT: u32 = 7;

/// The pixels of new objects over one cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Figure {
    /// Number of pixels.
    pub pixels: u32,
    /// Height of the highest of these pixels, in millimetres.
    pub top: u16,
    /// Number of these pixels in each 128 mm layer.
    pub layers: [u16; LAYERS],
}

/// Pixel counts for each cell of one image.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Evidence {
    /// For each cell the number of pixels on its floor and the number on obstacles; a last pair counts
    /// pixels outside all cells.
    counts: Vec<u32>,
    figures: Vec<Figure>,
    /// The cells that have a figure, in the order in which they were found.
    touched: Vec<u32>,
}

impl Evidence {
    /// Computes the evidence of an image: one depth in millimetres for each ray.
    pub fn fuse(&mut self, rays: &RayTable, background: &Background, depths: &[u16]) {
        self.clear(rays);
        self.counts.clear();
        self.counts.extend_from_slice(background.totals());
        let homes = background.homes();
        let counts = self.counts.as_mut_slice();
        let nowhere = counts.len() - 1;
        let changes = Changes::of(background, depths, rays.size().0 as usize, |blank| {
            for &pixel in blank {
                counts[homes[pixel] as usize] -= 1;
            }
            counts[nowhere] += blank.len() as u32;
        });
        for (first, word) in (0..).step_by(WORD).zip(changes.words()) {
            for at in ones(word.nearer | word.farther) {
                let (pixel, is) = (first + at, |word: u64| word >> at & 1 > 0);
                self.counts[homes[pixel] as usize] -= 1;
                if is(word.backed) {
                    self.add(rays, pixel, depths[pixel], is(word.nearer));
                } else {
                    self.counts[nowhere] += 1;
                }
            }
        }
    }

    /// Computes the same as [`Evidence::fuse`] pixel by pixel: a pixel that agrees with the background
    /// counts for its learnt point, any other for its measured point.
    pub fn scatter(&mut self, rays: &RayTable, background: &Background, depths: &[u16]) {
        self.clear(rays);
        self.counts.clear();
        self.counts.resize(background.totals().len(), 0);
        for (pixel, &depth) in depths.iter().enumerate() {
            if background.agrees(pixel, depth) {
                self.counts[background.settle(rays, pixel) as usize] += 1;
            } else if depth > 0 && is_backed(rays, background, depths, pixel) {
                self.add(rays, pixel, depth, background.is_nearer(pixel, depth));
            } else {
                *self.nowhere() += 1;
            }
        }
    }

    /// The cells with pixels of new objects and their figures, in the order of the cells.
    pub fn figures(&mut self) -> impl Iterator<Item = (usize, &Figure)> {
        self.touched.sort_unstable();
        self.touched.iter().map(|&cell| (cell as usize, &self.figures[cell as usize]))
    }

    /// The number of pixels on the floor of a cell, and on obstacles over it.
    pub(super) fn pixels(&self, cell: usize) -> (u32, u32) {
        (self.counts[2 * cell], self.counts[2 * cell + 1])
    }

    /// Number of pixels of new objects over a cell.
    pub(super) fn figure_pixels(&self, cell: usize) -> u32 {
        self.figures.get(cell).map_or(0, |figure| figure.pixels)
    }

    fn clear(&mut self, rays: &RayTable) {
        self.figures.resize(rays.cells(), Figure::default());
        for cell in self.touched.drain(..) {
            self.figures[cell as usize] = Figure::default();
        }
    }

    /// Counts a pixel whose depth disagrees with its background.
    #[inline]
    fn add(&mut self, rays: &RayTable, pixel: usize, depth: u16, is_nearer: bool) {
        // The window already allows for noise.
        let allowance = if is_nearer { Allowance::None } else { Allowance::Measured };
        match rays.zone(pixel, depth, allowance) {
            // Floor behind the background was hidden by it.
            Zone::Floor(cell) => self.counts[2 * cell as usize] += 1,
            Zone::Band(cell, height) | Zone::Above(cell, height) if is_nearer => {
                let figure = &mut self.figures[cell as usize];
                if figure.pixels == 0 {
                    self.touched.push(cell);
                }
                figure.pixels += 1;
                figure.top = figure.top.max(height);
                let layer = &mut figure.layers[usize::from(height >> LAYER_SHIFT).min(LAYERS - 1)];
                *layer = layer.saturating_add(1);
            }
            // An obstacle behind the background must be learnt first.
            Zone::Band(..) | Zone::Above(..) | Zone::Nowhere => *self.nowhere() += 1,
        }
    }

    /// The counter of the pixels that count for no cell.
    fn nowhere(&mut self) -> &mut u32 {
        let last = self.counts.len() - 1;
        &mut self.counts[last]
    }
}

/// Whether a horizontal and a vertical neighbour are on the same side of their backgrounds.
/// Isolated pixels are noise, or mixed pixels at an edge; pixels without a background have no side.
fn is_backed(rays: &RayTable, background: &Background, depths: &[u16], pixel: usize) -> bool {
    let width = rays.size().0 as usize;
    let side = |pixel: usize| background.side(pixel, depths.get(pixel).copied().unwrap_or(0));
    let own = side(pixel);
    let is_same = |pixel: usize| side(pixel) == own;
    let either =
        |step: usize| is_same(pixel + step) || pixel.checked_sub(step).is_some_and(is_same);
    own.is_some() && either(1) && either(width)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use ubimap_protocol::time::Instant;

    use super::*;
    use crate::camera::DepthNoise;
    use crate::perception::{
        ray_table::Survey,
        testing::{Cuboid, lens, noisy, render},
    };

    /// The rays of a camera in a room with a box, and its background after the initial learning.
    fn learnt(
        width: u32,
        at: [f64; 3],
        room: &[Cuboid],
        seed: u64,
    ) -> (RayTable, Background, crate::camera::Lens) {
        let lens = lens(width, 60, at, [1.0, 1.0, 0.0]);
        let rays = RayTable::new(&lens, &DepthNoise::D435, Survey::default());
        let mut background = Background::new(&rays);
        let empty = render(&lens, 0.01, room);
        for frame in 0..15 {
            let image = noisy(&empty, &DepthNoise::D435, seed + frame, 980);
            let taken = vec![false; rays.cells()];
            background.learn(&rays, &image, Instant(frame * 300_000), &taken);
        }
        assert!(background.is_learnt());
        (rays, background, lens)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        /// `fuse` (64 pixels at a time) and `scatter` (one by one) agree for any image at any time.
        #[test]
        fn fuse_and_scatter_give_the_same_evidence(
            width in 61..83_u32,
            eye in (-0.5..1.5, -0.5..1.5, 0.3..3.0),
            stands in (0.0..1.5, 0.0..1.5, 0.05..2.0),
            comes in (0.0..1.5, 0.0..1.5, 0.05..2.0),
            seed in 0..1_000_u64,
            good in 0..1_000_u64,
        ) {
            let cuboid = |(x, y, z): (f64, f64, f64)| [[x, y, 0.0], [x + 0.3, y + 0.4, z]];
            let at = [eye.0, eye.1, eye.2];
            let (rays, mut background, lens) = learnt(width, at, &[cuboid(stands)], seed);
            let scenes = [vec![cuboid(stands), cuboid(comes)], vec![cuboid(comes)], vec![]];
            let (mut fast, mut plain) = (Evidence::default(), Evidence::default());
            let taken = vec![false; rays.cells()];
            for (turn, scene) in (0_u64..).zip(scenes.iter().cycle().take(60)) {
                let image = noisy(&render(&lens, 0.0, scene), &DepthNoise::D435, seed ^ turn, good);
                fast.fuse(&rays, &background, &image);
                plain.scatter(&rays, &background, &image);
                prop_assert_eq!(&fast, &plain);
                let figures = fast.figures.iter().map(|it| it.pixels).sum::<u32>();
                prop_assert_eq!(fast.counts.iter().sum::<u32>() + figures, width * 60);
                background.learn(&rays, &image, Instant(5_000_000 + turn * 1_000_000), &taken);
            }
        }
    }
}
