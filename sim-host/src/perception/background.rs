//! The background of a camera: what each pixel sees in the empty room. It is learnt in the first
//! seconds, and learnt again where the room changes permanently.
//!
//! A pixel agrees with its background if its depth is within a learnt window. It then counts for
//! the cell of the *learnt* point, so that noise does not smear static objects. The learnt depth is
//! the mean of all depths that agreed, and is used once its standard error is below half a cell. A
//! single depth at 5 m has a noise of two cells, the mean of `n` depths 1/sqrt(n) of that, so the
//! range of view grows with time. If the recent depths of a floor pixel agree one by one, but their
//! mean does not, an object closer to the floor than the noise may stand there: the pixel then
//! counts for nothing. Learning also absorbs calibration errors, such as a floor 1 cm off.

use ubimap_protocol::time::{Duration, Instant};

use super::ray_table::{Allowance, RayTable, Survey, Zone};

/// Number of depths per pixel after which the background is learnt.
const SAMPLES: usize = 15;
/// Interval between these depths.
const SAMPLE_INTERVAL: Duration = Duration::from_millis(300);
/// Minimum number of measurements: a pixel with fewer has no background.
const MIN_SAMPLES: usize = 8;
/// The background is the depth that 1/TRIM of the samples exceed, so that a person who stands in
/// front of it most of the time leaves no trace.
const TRIM: usize = 5;
/// Half the width of a pixel's window, in thousandths of sigma: 99 % of the background's depths lie
/// inside. A wider window would hide what stands just in front of the floor.
const WINDOW: i64 = 2_576;
/// Margin for quantisation in millimetres, added to the window.
const SLACK_MM: i64 = 4;
/// Per frame, one in this number of rows is checked for permanent changes.
const ROWS_BETWEEN: u32 = 8;
/// Number of checks and seconds without a change after which an object in front of the background,
/// or where there was no background, becomes background. Long, because it may be a person.
const STAY: (u8, u32) = (6, 10);
/// Like `STAY`, for floor and for anything behind the background. Shorter: it was only hidden.
const UNCOVERED: (u8, u32) = (2, 1);
/// When this number of depths have agreed, half of them are forgotten, so that drift is followed.
const MAX_AGREED: u32 = 256;

/// A depth that may become a pixel's background, and the state of the pixel.
#[derive(Clone, Copy, Debug, Default)]
struct Candidate {
    depth: u16,
    looks: u8,
    /// Whether the current background replaced the one learnt first.
    has_come: bool,
    /// Whether the depths that agreed recently may belong to another object: the pixel then counts
    /// for nothing.
    is_doubtful: bool,
    since_s: u32,
}

/// The position of a depth that disagrees with the background.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Side {
    Nearer,
    Farther,
}

/// Sum and number of the depths that agreed.
#[derive(Clone, Copy, Debug, Default)]
struct Agreed {
    sum: u32,
    count: u32,
}

impl Agreed {
    fn mean(self) -> Option<u16> {
        (self.sum + self.count / 2).checked_div(self.count).map(|mean| mean as u16)
    }
}

/// The background of one camera.
#[derive(Clone, Debug)]
pub struct Background {
    /// Depths in millimetres; zero until the standard error is below half a cell.
    depth: Vec<u16>,
    agreed: Vec<Agreed>,
    /// Depths that agreed since the pixel's row was last checked.
    fresh: Vec<Agreed>,
    /// The lowest depth of each pixel's window. A pixel without background has a window of zero only.
    low: Vec<u16>,
    /// The width of each pixel's window.
    span: Vec<u16>,
    /// For each pixel, its index in `totals` if it agrees: twice the cell, plus one for an
    /// obstacle.
    home: Vec<u32>,
    /// The evidence that results if all pixels agree.
    totals: Vec<u32>,
    candidates: Vec<Candidate>,
    /// The samples, image by image; `None` once the background is learnt.
    samples: Option<Vec<u16>>,
    /// When the next sample is due.
    due: Instant,
    /// The first row to check next.
    turn: u32,
}

impl Background {
    /// The background of a camera that has not seen anything.
    pub fn new(rays: &RayTable) -> Self {
        let pixels = rays.pixels();
        let nowhere = 2 * rays.cells();
        let mut totals = vec![0; nowhere + 2];
        totals[nowhere + 1] = pixels as u32;
        Self {
            depth: vec![0; pixels],
            agreed: vec![Agreed::default(); pixels],
            fresh: vec![Agreed::default(); pixels],
            low: vec![0; pixels],
            span: vec![0; pixels],
            home: vec![nowhere as u32 + 1; pixels],
            totals,
            candidates: vec![Candidate::default(); pixels],
            samples: Some(Vec::new()),
            due: Instant::default(),
            turn: 0,
        }
    }

    /// Counts each pixel for the cell that it sees on other rays: those of a camera that has drifted.
    pub(super) fn reseat(&mut self, rays: &RayTable) {
        self.totals.clear();
        self.totals.resize(2 * rays.cells() + 2, 0);
        for pixel in 0..self.home.len() {
            self.home[pixel] = self.settle(rays, pixel);
            self.totals[self.home[pixel] as usize] += 1;
        }
    }

    /// Whether the initial learning is complete.
    pub fn is_learnt(&self) -> bool {
        self.samples.is_none()
    }

    /// Learns from an image; call it in the order of capture. Pixels over cells that are `taken`, by a
    /// robot or a walking person, are not learnt.
    pub fn learn(&mut self, rays: &RayTable, depths: &[u16], captured: Instant, taken: &[bool]) {
        let Some(samples) = &mut self.samples else {
            self.gather(depths);
            return self.tend(rays, depths, captured, taken);
        };
        if captured < self.due {
            return;
        }
        self.due = captured + SAMPLE_INTERVAL;
        let sample = |(pixel, &depth): (usize, &u16)| {
            if is_taken(rays, pixel, depth, taken) { 0 } else { depth }
        };
        samples.extend(depths.iter().enumerate().map(sample));
        if samples.len() >= SAMPLES * depths.len() {
            let samples = self.samples.take().unwrap_or_default();
            self.settle_all(rays, &samples);
        }
    }

    /// The lowest depth and the width of each pixel's window.
    pub(super) fn windows(&self) -> (&[u16], &[u16]) {
        (&self.low, &self.span)
    }

    pub(super) fn totals(&self) -> &[u32] {
        &self.totals
    }

    /// For each pixel its index in [`Background::totals`] when it agrees.
    pub(super) fn homes(&self) -> &[u32] {
        &self.home
    }

    pub(super) fn agrees(&self, pixel: usize, depth: u16) -> bool {
        depth.wrapping_sub(self.low[pixel]) <= self.span[pixel]
    }

    /// The side of the background on which a disagreeing pixel lies; `None` if it agrees or has no
    /// measurement or background.
    pub(super) fn side(&self, pixel: usize, depth: u16) -> Option<Side> {
        let is_known = *self.low.get(pixel)? > 0 && depth > 0 && !self.agrees(pixel, depth);
        is_known.then(|| if depth < self.low[pixel] { Side::Nearer } else { Side::Farther })
    }

    /// Whether a depth is nearer than the background.
    pub(super) fn is_nearer(&self, pixel: usize, depth: u16) -> bool {
        depth > 0 && depth < self.low[pixel]
    }

    /// Recomputes the pixel's entry in [`Background::homes`].
    pub(super) fn settle(&self, rays: &RayTable, pixel: usize) -> u32 {
        let candidate = &self.candidates[pixel];
        let slot = match rays.zone(pixel, self.depth[pixel], Allowance::Learnt) {
            _ if candidate.is_doubtful => self.totals.len() - 1,
            Zone::Floor(cell) => 2 * cell as usize,
            Zone::Band(cell, _) => 2 * cell as usize + 1,
            // A new object stands on the floor; an object that was always there may hang.
            Zone::Above(cell, _) if candidate.has_come => 2 * cell as usize + 1,
            Zone::Above(..) | Zone::Nowhere => self.totals.len() - 1,
        };
        slot as u32
    }

    /// Ends the initial learning: computes each pixel's background from its farthest samples.
    fn settle_all(&mut self, rays: &RayTable, samples: &[u16]) {
        let pixels = self.depth.len();
        let mut seen = Vec::with_capacity(SAMPLES);
        for pixel in 0..pixels {
            seen.clear();
            let all = samples.iter().skip(pixel).step_by(pixels);
            seen.extend(all.copied().filter(|depth| *depth > 0));
            if seen.len() < MIN_SAMPLES {
                continue;
            }
            seen.sort_unstable();
            let far = seen[seen.len() - 1 - seen.len() / TRIM];
            let room = &seen[seen.partition_point(|depth| *depth < far - margin(rays, far))..];
            let sum = room.iter().map(|depth| u32::from(*depth)).sum();
            self.agreed[pixel] = Agreed { sum, count: room.len() as u32 };
            self.settle_again(rays, pixel);
        }
    }

    /// Recomputes a pixel's background depth, its window, and the index in `totals` that it counts for.
    fn settle_again(&mut self, rays: &RayTable, pixel: usize) {
        let agreed = &mut self.agreed[pixel];
        let fresh = core::mem::take(&mut self.fresh[pixel]);
        agreed.sum += fresh.sum;
        agreed.count += fresh.count;
        let Some(mean) = agreed.mean() else { return };
        if agreed.count >= MAX_AGREED {
            *agreed = Agreed { sum: agreed.sum / 2, count: agreed.count / 2 };
        }
        let margin = margin(rays, mean);
        self.low[pixel] = mean - margin;
        self.span[pixel] = 2 * margin;
        let Survey { side, reach, .. } = rays.survey();
        let (noise, side) = (rays.sigma_mm(mean), i64::from(side.0));
        // If a sensor reports no depths beyond its reach, part of the noise is cut off, which would
        // bias the mean towards the camera.
        let is_good = i64::from(mean) + i64::from(margin) <= i64::from(reach.0)
            // 92 % of such means (1.73 sigmas) are within the side of a cell.
            && 3 * noise * noise <= side * side * i64::from(agreed.count);
        self.depth[pixel] = if is_good { mean } else { 0 };
        self.totals[self.home[pixel] as usize] -= 1;
        self.home[pixel] = self.settle(rays, pixel);
        self.totals[self.home[pixel] as usize] += 1;
    }

    /// Accumulates the depths that agree with the background.
    fn gather(&mut self, depths: &[u16]) {
        let windows = self.low.iter().zip(&self.span);
        for ((fresh, &depth), (&low, &span)) in self.fresh.iter_mut().zip(depths).zip(windows) {
            // Without a background, a depth of zero agrees.
            let one = u32::from(depth > 0 && depth.wrapping_sub(low) <= span);
            fresh.sum += one * u32::from(depth);
            fresh.count += one;
        }
    }

    /// Checks some of the rows for permanent changes.
    fn tend(&mut self, rays: &RayTable, depths: &[u16], captured: Instant, taken: &[bool]) {
        let now_s = (captured.0 / 1_000_000) as u32;
        let width = rays.size().0 as usize;
        let rows = depths.chunks(width).enumerate().skip(self.turn as usize);
        for (row, depths) in rows.step_by(ROWS_BETWEEN as usize) {
            for (pixel, &depth) in (row * width..).zip(depths) {
                if is_taken(rays, pixel, depth, taken) {
                    // The depths that agreed may be from a person's legs.
                    self.fresh[pixel] = Agreed::default();
                } else {
                    self.look(rays, pixel, depth, now_s);
                }
                self.settle_again(rays, pixel);
            }
        }
        self.turn = (self.turn + 1) % ROWS_BETWEEN;
    }

    /// Checks whether a pixel still sees its background, or something that may replace it.
    fn look(&mut self, rays: &RayTable, pixel: usize, depth: u16, now_s: u32) {
        if self.fresh[pixel].count > 0 {
            self.candidates[pixel].is_doubtful = self.is_doubtful(rays, pixel);
        }
        if let Some(other) = self.sees_other(rays, pixel, depth) {
            if self.uncovers(rays, pixel, other) {
                self.replace(rays, pixel, other, false);
            } else if let Some(depth) = other.mean() {
                self.consider(rays, pixel, depth, now_s);
            }
        } else if depth > 0 {
            let candidate = &mut self.candidates[pixel];
            let may_be = depth.abs_diff(candidate.depth) <= spread(rays, depth);
            candidate.looks = if may_be { candidate.looks.saturating_sub(1) } else { 0 };
        }
    }

    /// The depths that agreed since the last check, if their mean shows that they belong to
    /// something other than the background.
    fn other_of_late(&self, rays: &RayTable, pixel: usize) -> Option<Agreed> {
        let fresh = self.fresh[pixel];
        is_other(rays, fresh, self.agreed[pixel]).then_some(fresh)
    }

    /// Whether the depths that agreed since the last check contradict the background: a floor pixel whose
    /// mean is off, or an obstacle whose mean is consistent with floor (a person stood there during
    /// learning).
    fn is_doubtful(&self, rays: &RayTable, pixel: usize) -> bool {
        let is_in_the_way = |depth, allowance| {
            matches!(rays.zone(pixel, depth, allowance), Zone::Band(..) | Zone::Above(..))
        };
        let fresh = self.fresh[pixel];
        let means = self.agreed[pixel].mean().zip(fresh.mean());
        means.is_some_and(|(before, mean)| {
            if is_in_the_way(before, Allowance::Learnt) {
                !is_in_the_way(mean, Allowance::Mean(fresh.count))
            } else {
                self.other_of_late(rays, pixel).is_some()
            }
        })
    }

    /// What a pixel sees, if that is not the background. Either the mean of the depths that agreed
    /// recently, if it is off; these depths then no longer count as agreeing. Or the depth itself,
    /// if it is outside the window, or closer to the candidate than to the background: because of
    /// noise, an object just in front of the background agrees now and then.
    fn sees_other(&mut self, rays: &RayTable, pixel: usize, depth: u16) -> Option<Agreed> {
        if let Some(other) = self.other_of_late(rays, pixel) {
            self.fresh[pixel] = Agreed::default();
            return Some(other);
        }
        let one = Agreed { sum: u32::from(depth), count: 1 };
        if depth == 0 || !self.agrees(pixel, depth) {
            return (depth > 0).then_some(one);
        }
        let candidate = &self.candidates[pixel];
        let mean = self.low[pixel] + self.span[pixel] / 2;
        let is_nearer = candidate.looks > 0
            && !self.agrees(pixel, candidate.depth)
            && depth.abs_diff(candidate.depth) < depth.abs_diff(mean);
        is_nearer.then_some(one)
    }

    /// Whether agreeing depths show that something left which had hidden the background: a person
    /// who stood in view during learning, so close to the floor that the depth is within the
    /// window. Floor hides nothing, so the background must be an obstacle.
    fn uncovers(&self, rays: &RayTable, pixel: usize, seen: Agreed) -> bool {
        let is_farther = self.agreed[pixel].mean() < seen.mean();
        let home = self.home[pixel] as usize;
        seen.count > 1 && is_farther && home < 2 * rays.cells() && home % 2 == 1
    }

    /// Replaces the background of a pixel.
    fn replace(&mut self, rays: &RayTable, pixel: usize, seen: Agreed, has_come: bool) {
        self.candidates[pixel] = Candidate { has_come, ..Candidate::default() };
        self.agreed[pixel] = seen;
        self.settle_again(rays, pixel);
    }

    /// Updates the candidate of a pixel that sees something other than its background.
    fn consider(&mut self, rays: &RayTable, pixel: usize, depth: u16, now_s: u32) {
        let candidate = &mut self.candidates[pixel];
        if candidate.looks == 0 || depth.abs_diff(candidate.depth) > spread(rays, depth) {
            *candidate = Candidate { depth, looks: 1, since_s: now_s, ..*candidate };
            return;
        }
        // The mean over all looks.
        let looks = u32::from(candidate.looks);
        let sum = u32::from(candidate.depth) * looks + u32::from(depth);
        candidate.depth = (sum / (looks + 1)) as u16;
        candidate.looks = candidate.looks.saturating_add(1);
        let Candidate { depth, looks, since_s, .. } = *candidate;
        let is_nearer = depth < self.low[pixel] + self.span[pixel] / 2;
        let is_floor = matches!(rays.zone(pixel, depth, Allowance::Measured), Zone::Floor(_));
        let may_be_somebody = if self.low[pixel] > 0 { is_nearer } else { !is_floor };
        let (enough, seconds) = if may_be_somebody { STAY } else { UNCOVERED };
        if looks >= enough && now_s.saturating_sub(since_s) >= seconds {
            let looks = u32::from(looks);
            let seen = Agreed { sum: u32::from(depth) * looks, count: looks };
            self.replace(rays, pixel, seen, is_nearer);
        }
    }
}

/// Whether the mean of `depths` is farther from that of `agreed` than 99 % of such means would be.
/// So of two objects in one window (the floor and feet), neither biases the mean of the other.
fn is_other(rays: &RayTable, depths: Agreed, agreed: Agreed) -> bool {
    let Some((mean, before)) = depths.mean().zip(agreed.mean()) else { return false };
    let off = u64::from(mean.abs_diff(before));
    off * off * u64::from(depths.count) > u64::from(margin(rays, before)).pow(2)
}

/// Maximum difference of two depths of one object.
fn spread(rays: &RayTable, depth: u16) -> u16 {
    let noise = (WINDOW * rays.sigma_mm(depth) + 500) / 1_000;
    (SLACK_MM + noise).min(i64::from(u16::MAX)) as u16
}

/// Half the width of the window around a depth, at most half the depth.
fn margin(rays: &RayTable, depth: u16) -> u16 {
    spread(rays, depth).min(depth / 2)
}

/// Whether a pixel sees an obstacle over a cell that is taken.
fn is_taken(rays: &RayTable, pixel: usize, depth: u16, taken: &[bool]) -> bool {
    match rays.zone(pixel, depth, Allowance::Measured) {
        Zone::Band(cell, _) | Zone::Above(cell, _) => taken[cell as usize],
        Zone::Floor(_) | Zone::Nowhere => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{DepthImage, DepthNoise},
        perception::testing::{lens, noisy, render},
    };

    /// A floor, and legs everywhere, two sigmas in front of it, so that their depths fall into the
    /// window of the floor.
    fn floor_and_legs() -> (RayTable, DepthImage, DepthImage) {
        let lens = lens(160, 60, [0.0, 0.0, 2.8], [4.0, 3.0, 0.0]);
        let rays = RayTable::new(&lens, &DepthNoise::D435, Survey::default());
        let floor = render(&lens, 0.0, &[]);
        let legs = DepthImage::from_fn(160, 60, |x, y| {
            let depth = floor.get_pixel(x, y)[0];
            image::Luma([depth - 2 * rays.sigma_mm(depth) as u16])
        });
        (rays, floor, legs)
    }

    #[test]
    fn people_on_the_floor_do_not_bias_its_depth() {
        let (rays, floor, legs) = floor_and_legs();
        let taken = vec![false; rays.cells()];
        let mut background = Background::new(&rays);
        // Five images a second; a person stands there for two of every six seconds.
        for frame in 0..450 {
            let is_there = frame % 30 < 10;
            let image = noisy(if is_there { &legs } else { &floor }, &DepthNoise::D435, frame, 980);
            background.learn(&rays, &image, Instant(frame * 200_000), &taken);
        }
        let depths = floor.iter().zip(&background.depth);
        let far = depths.filter(|(floor, learnt)| (4_500..6_000).contains(*floor) && **learnt > 0);
        let off = far.map(|(floor, learnt)| {
            (i64::from(*floor) - i64::from(*learnt)) as f64 / rays.sigma_mm(*floor) as f64
        });
        let off: Vec<f64> = off.collect();
        let mean = off.iter().sum::<f64>() / off.len() as f64;
        let many = off.iter().filter(|off| **off > 1.0).count();
        assert!(off.len() > 2_000 && mean < 0.4 && many < 10, "{mean} sigmas, {many} over one");
    }

    /// Number of pixels between 4.5 and 5.5 m that count for floor, and for obstacles.
    fn far(rays: &RayTable, floor: &DepthImage, background: &Background) -> [usize; 2] {
        let homes = floor.iter().zip(background.homes());
        let far = homes.filter(|(floor, _)| (4_500..5_500).contains(*floor));
        let far = far.filter(|&(_, &home)| (home as usize) < 2 * rays.cells());
        far.fold([0; 2], |mut counts, (_, home)| {
            counts[(home % 2) as usize] += 1;
            counts
        })
    }

    #[test]
    fn no_floor_is_reported_under_a_person_hidden_by_noise() {
        let (rays, floor, legs) = floor_and_legs();
        let taken = vec![false; rays.cells()];
        let mut background = Background::new(&rays);
        let (comes, ends) = (70, 70 + 2 * u64::from(ROWS_BETWEEN));
        let mut learn = |frames: core::ops::Range<u64>, image: &DepthImage| {
            for frame in frames {
                let image = noisy(image, &DepthNoise::D435, frame, 980);
                background.learn(&rays, &image, Instant(frame * 200_000), &taken);
            }
            far(&rays, &floor, &background)
        };
        let [before, blocked] = learn(0..comes, &floor);
        assert!(before > 2_000 && 50 * blocked < before, "{before} and {blocked} pixels");
        let [after, _] = learn(comes..ends, &legs);
        assert!(10 * after < before, "{before} pixels, then {after}");
    }

    #[test]
    fn a_person_in_view_during_learning_leaves_no_trace() {
        let (rays, floor, legs) = floor_and_legs();
        let taken = vec![false; rays.cells()];
        let mut background = Background::new(&rays);
        let mut learn = |frames: core::ops::Range<u64>, image: &DepthImage| {
            for frame in frames {
                let image = noisy(image, &DepthNoise::D435, frame, 980);
                background.learn(&rays, &image, Instant(frame * 200_000), &taken);
            }
            far(&rays, &floor, &background)[1]
        };
        // Five images a second, until every pixel has been checked twice.
        let (leaves, ends) = (50, 50 + 2 * u64::from(ROWS_BETWEEN));
        let before = learn(0..leaves, &legs);
        let after = learn(leaves..ends, &floor);
        assert!(before > 1_000 && 10 * after < before, "{before} pixels, then {after}");
    }
}
