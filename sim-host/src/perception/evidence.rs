//! The evidence of one depth image: for each cell the pixels that saw its floor, something in the
//! way of the robots, or something that was not there when the background was learnt.
//!
//! Most pixels of a camera that stands still see what they always see. [`Evidence::fuse`] therefore
//! begins with what the background says of all cells, compares pixels with their windows, sixteen at
//! a time, and corrects what a pixel outside of its window says. [`Evidence::scatter`] is the plain
//! way to the same evidence, pixel by pixel: the oracle and the yardstick.

use crate::camera::LAYERS;

use super::{
    background::Background,
    changes::{Changes, WORD, ones},
    ray_table::{Allowance, RayTable, Zone},
};

/// A layer of a height profile is 128 mm high.
pub(super) const LAYER_SHIFT: u32 = 7;

/// What was not there before, over one cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Figure {
    /// Pixels that saw it.
    pub pixels: u32,
    /// The highest of them, in millimetres.
    pub top: u16,
    /// How many of them in each layer of 128 mm.
    pub layers: [u16; LAYERS],
}

/// What the pixels of one image say of each cell.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Evidence {
    /// For each cell the pixels on its floor, and those in the way of the robots; then one pair for
    /// what is nowhere.
    counts: Vec<u32>,
    figures: Vec<Figure>,
    /// The cells that have a figure, in the order in which they were found.
    touched: Vec<u32>,
}

impl Evidence {
    /// Takes the depths of an image, in millimetres and one for each ray.
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

    /// The same, pixel by pixel: what agrees with the background is taken to be as deep as that,
    /// then each point is put into its cell.
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

    /// What was not there before, over the cells that have any of it, in the order of the cells.
    pub fn figures(&mut self) -> impl Iterator<Item = (usize, &Figure)> {
        self.touched.sort_unstable();
        self.touched.iter().map(|&cell| (cell as usize, &self.figures[cell as usize]))
    }

    /// The pixels on the floor of a cell, and those in the way of the robots over it.
    pub(super) fn pixels(&self, cell: usize) -> (u32, u32) {
        (self.counts[2 * cell], self.counts[2 * cell + 1])
    }

    /// How many pixels see something over a cell that was not there before.
    pub(super) fn figure_pixels(&self, cell: usize) -> u32 {
        self.figures.get(cell).map_or(0, |figure| figure.pixels)
    }

    fn clear(&mut self, rays: &RayTable) {
        self.figures.resize(rays.cells(), Figure::default());
        for cell in self.touched.drain(..) {
            self.figures[cell as usize] = Figure::default();
        }
    }

    /// Counts a pixel that sees something else than its background, nearer or farther than that.
    #[inline]
    fn add(&mut self, rays: &RayTable, pixel: usize, depth: u16, is_nearer: bool) {
        // The window has the noise in it already.
        let allowance = if is_nearer { Allowance::None } else { Allowance::Measured };
        match rays.zone(pixel, depth, allowance) {
            // Behind the background is what it hid.
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
            // What stands behind has to be learnt first.
            Zone::Band(..) | Zone::Above(..) | Zone::Nowhere => *self.nowhere() += 1,
        }
    }

    /// The pixels that say nothing of any cell.
    fn nowhere(&mut self) -> &mut u32 {
        let last = self.counts.len() - 1;
        &mut self.counts[last]
    }
}

/// Whether a neighbour in the row and one in the column are on the same side of their background: a
/// pixel that stands out alone is noise, or mixed at an edge, and one without a background cannot.
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

    /// The rays of a camera in a room with a box, and its background after the first seconds.
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

        /// Sixteen pixels at a time or one by one, whatever is in the image and whenever.
        #[test]
        fn both_ways_lead_to_the_same_evidence(
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
