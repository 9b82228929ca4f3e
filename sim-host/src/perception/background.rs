//! What each pixel of a camera sees when nobody is there: learnt in the first seconds, and anew
//! where it changes for good.
//!
//! A pixel agrees with its background if its depth is within a window, learnt as well. It then
//! counts for the cell in which the *learnt* point is, so that noise does not smear what stands
//! still; which cell that is, is found now and then. The learnt depth is the mean of all that
//! agreed, and counts for nothing before it is good to half a cell: the noise of one depth is two
//! cells at 5 m, that of the mean of `n` is smaller by the root of `n`. So the view reaches farther
//! the longer a camera looks. A pixel of the floor whose newest depths agree one by one, but not in their
//! mean, counts for nothing: something may stand there that is less than the noise before it. Learning also
//! takes up what calibration leaves: a floor that is a centimetre off, a threshold, a carpet.

use ubimap_protocol::time::{Duration, Instant};

use super::ray_table::{Allowance, RayTable, Survey, Zone};

/// Depths of each pixel that are learnt from, and the time from one to the next.
const SAMPLES: usize = 15;
const SAMPLE_INTERVAL: Duration = Duration::from_millis(300);
/// A pixel that measured less often has no background.
const FEWEST_SAMPLES: usize = 8;
/// What is farthest in one sample of so many is the room: whoever stands before it for the rest of
/// the time leaves nothing behind.
const TRIM: usize = 5;
/// Added to what noise explains, in millimetres: quantisation.
const SLACK_MM: i64 = 4;
/// After a frame, one row in so many is looked at for changes that last.
const ROWS_BETWEEN: u32 = 8;
/// What is nearer than the background becomes background after so many looks and seconds without a
/// change, for it may be somebody; so does what stands where there was no background. Floor, and
/// what is farther than the background, was hidden until now, and becomes it sooner.
const STAY: (u8, u32) = (6, 10);
const UNCOVERED: (u8, u32) = (2, 1);
/// When so many depths have agreed, half of them are forgotten: a drift is followed.
const MOST_AGREED: u32 = 256;

/// A depth that may become the background of a pixel.
#[derive(Clone, Copy, Debug, Default)]
struct Candidate {
    depth: u16,
    looks: u8,
    /// Whether the present background came after the first was learnt.
    has_come: bool,
    /// Whether what agreed with the background of late may be something else: the pixel then counts for
    /// nothing.
    is_doubtful: bool,
    since_s: u32,
}

/// Where a depth is that does not agree with the background.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Side {
    Nearer,
    Farther,
}

/// The depths that agreed.
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
    /// In millimetres; zero where there is none that is good to half a cell.
    depth: Vec<u16>,
    agreed: Vec<Agreed>,
    /// Those that agreed since the pixel's row was last looked at.
    fresh: Vec<Agreed>,
    /// The lowest depth of each pixel's window, and how much more the highest is. Without a
    /// background only nothing agrees.
    low: Vec<u16>,
    span: Vec<u16>,
    /// For each pixel what it counts for where it agrees: twice its cell, one more for what is in
    /// the way.
    home: Vec<u32>,
    /// What all pixels would say together if all agreed.
    totals: Vec<u32>,
    candidates: Vec<Candidate>,
    /// The samples, image by image, as long as it learns.
    samples: Option<Vec<u16>>,
    /// When the next one is due.
    due: Instant,
    /// The first row that is looked at next.
    turn: u32,
}

impl Background {
    /// Of a camera that has not seen anything.
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

    /// Whether the first seconds are over.
    pub fn is_learnt(&self) -> bool {
        self.samples.is_none()
    }

    /// Takes an image that was captured at a time, in the order of capture. Cells that are `taken`,
    /// by a robot or by somebody who walks, are not learnt.
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

    /// The lowest depth of each pixel's window, and how much more the highest is.
    pub(super) fn windows(&self) -> (&[u16], &[u16]) {
        (&self.low, &self.span)
    }

    pub(super) fn totals(&self) -> &[u32] {
        &self.totals
    }

    /// For each pixel the place in [`Background::totals`] that it counts for where it agrees.
    pub(super) fn homes(&self) -> &[u32] {
        &self.home
    }

    pub(super) fn agrees(&self, pixel: usize, depth: u16) -> bool {
        depth.wrapping_sub(self.low[pixel]) <= self.span[pixel]
    }

    /// On which side of its background, if it has one, a pixel that does not agree with it is.
    pub(super) fn side(&self, pixel: usize, depth: u16) -> Option<Side> {
        let is_known = *self.low.get(pixel)? > 0 && depth > 0 && !self.agrees(pixel, depth);
        is_known.then(|| if depth < self.low[pixel] { Side::Nearer } else { Side::Farther })
    }

    /// Whether a depth is nearer than the background.
    pub(super) fn is_nearer(&self, pixel: usize, depth: u16) -> bool {
        depth > 0 && depth < self.low[pixel]
    }

    /// What a pixel counts for where it agrees, as [`Background::homes`] has it, found anew.
    pub(super) fn settle(&self, rays: &RayTable, pixel: usize) -> u32 {
        let candidate = &self.candidates[pixel];
        let slot = match rays.zone(pixel, self.depth[pixel], Allowance::Learnt) {
            _ if candidate.is_doubtful => self.totals.len() - 1,
            Zone::Floor(cell) => 2 * cell as usize,
            Zone::Band(cell, _) => 2 * cell as usize + 1,
            // What has come stands on the floor; what was always there may hang.
            Zone::Above(cell, _) if candidate.has_come => 2 * cell as usize + 1,
            Zone::Above(..) | Zone::Nowhere => self.totals.len() - 1,
        };
        slot as u32
    }

    /// Ends the learning: what most of the farthest samples of each pixel are about.
    fn settle_all(&mut self, rays: &RayTable, samples: &[u16]) {
        let pixels = self.depth.len();
        let mut seen = Vec::with_capacity(SAMPLES);
        for pixel in 0..pixels {
            seen.clear();
            let all = samples.iter().skip(pixel).step_by(pixels);
            seen.extend(all.copied().filter(|depth| *depth > 0));
            if seen.len() < FEWEST_SAMPLES {
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

    /// Finds anew how deep the background of a pixel is, the window about that, and what the pixel
    /// counts for.
    fn settle_again(&mut self, rays: &RayTable, pixel: usize) {
        let agreed = &mut self.agreed[pixel];
        let fresh = core::mem::take(&mut self.fresh[pixel]);
        agreed.sum += fresh.sum;
        agreed.count += fresh.count;
        let Some(mean) = agreed.mean() else { return };
        if agreed.count >= MOST_AGREED {
            *agreed = Agreed { sum: agreed.sum / 2, count: agreed.count / 2 };
        }
        let margin = margin(rays, mean);
        self.low[pixel] = mean - margin;
        self.span[pixel] = 2 * margin;
        let Survey { side, reach, .. } = rays.survey();
        let (noise, side) = (rays.sigma_mm(mean), i64::from(side.0));
        // A sensor that gives no depth beyond its reach cuts the noise off: the mean would be nearer
        // than what is there.
        let is_good = i64::from(mean) + i64::from(margin) <= i64::from(reach.0)
            && 4 * noise * noise <= side * side * i64::from(agreed.count);
        self.depth[pixel] = if is_good { mean } else { 0 };
        self.totals[self.home[pixel] as usize] -= 1;
        self.home[pixel] = self.settle(rays, pixel);
        self.totals[self.home[pixel] as usize] += 1;
    }

    /// Adds the depths that agree.
    fn gather(&mut self, depths: &[u16]) {
        let windows = self.low.iter().zip(&self.span);
        for ((fresh, &depth), (&low, &span)) in self.fresh.iter_mut().zip(depths).zip(windows) {
            // Zero agrees where there is no background.
            let one = u32::from(depth > 0 && depth.wrapping_sub(low) <= span);
            fresh.sum += one * u32::from(depth);
            fresh.count += one;
        }
    }

    /// Looks at some of the rows for what has changed for good.
    fn tend(&mut self, rays: &RayTable, depths: &[u16], captured: Instant, taken: &[bool]) {
        let now_s = (captured.0 / 1_000_000) as u32;
        let width = rays.size().0 as usize;
        let rows = depths.chunks(width).enumerate().skip(self.turn as usize);
        for (row, depths) in rows.step_by(ROWS_BETWEEN as usize) {
            for (pixel, &depth) in (row * width..).zip(depths) {
                if is_taken(rays, pixel, depth, taken) {
                    // Those that agreed may have been of somebody's legs.
                    self.fresh[pixel] = Agreed::default();
                } else {
                    self.look(rays, pixel, depth, now_s);
                }
                self.settle_again(rays, pixel);
            }
        }
        self.turn = (self.turn + 1) % ROWS_BETWEEN;
    }

    /// Looks at one pixel: whether it still sees its background, or something that may become it.
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

    /// The depths that agreed since the last look, if they are of something else than the background:
    /// their mean lies off.
    fn other_of_late(&self, rays: &RayTable, pixel: usize) -> Option<Agreed> {
        let fresh = self.fresh[pixel];
        is_other(rays, fresh, self.agreed[pixel]).then_some(fresh)
    }

    /// Whether what agreed since the last look is something else than the floor that is the background,
    /// or may be the floor where something in the way is: somebody stood on it when it was learnt.
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

    /// What a pixel sees if it is not the background: the depth if that is out of the window, or
    /// nearer to the candidate than to the background, for noise makes what stands a little before
    /// that agree with it now and then; and those that have agreed of late, which then do not count,
    /// if their mean lies off.
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

    /// Whether several depths, which agreed, show what was hidden by something that is in the way of
    /// the robots: who stood in view as long as the room was learnt, so little before the floor that
    /// this is in the window, has left. The floor itself hides nothing.
    fn uncovers(&self, rays: &RayTable, pixel: usize, seen: Agreed) -> bool {
        let is_farther = self.agreed[pixel].mean() < seen.mean();
        let home = self.home[pixel] as usize;
        seen.count > 1 && is_farther && home < 2 * rays.cells() && home % 2 == 1
    }

    /// Takes something else for the background of a pixel.
    fn replace(&mut self, rays: &RayTable, pixel: usize, seen: Agreed, has_come: bool) {
        self.candidates[pixel] = Candidate { has_come, ..Candidate::default() };
        self.agreed[pixel] = seen;
        self.settle_again(rays, pixel);
    }

    /// A pixel sees something else than its background.
    fn consider(&mut self, rays: &RayTable, pixel: usize, depth: u16, now_s: u32) {
        let candidate = &mut self.candidates[pixel];
        if candidate.looks == 0 || depth.abs_diff(candidate.depth) > spread(rays, depth) {
            *candidate = Candidate { depth, looks: 1, since_s: now_s, ..*candidate };
            return;
        }
        // The mean of the looks.
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

/// Whether depths are of something else than those that agreed: their mean is farther off than three of
/// its sigmas. Of two things in one window, as the floor and the feet of who stands on it now and then,
/// this lets neither draw the mean to it.
fn is_other(rays: &RayTable, depths: Agreed, agreed: Agreed) -> bool {
    let Some((mean, before)) = depths.mean().zip(agreed.mean()) else { return false };
    let off = u32::from(mean.abs_diff(before));
    off * off * depths.count > u32::from(margin(rays, before)).pow(2)
}

/// Depths that differ by no more may be of one thing: three sigmas.
fn spread(rays: &RayTable, depth: u16) -> u16 {
    (SLACK_MM + 3 * rays.sigma_mm(depth)).min(i64::from(u16::MAX)) as u16
}

/// Half the width of the window about a depth: three sigmas, and never all of the depth.
fn margin(rays: &RayTable, depth: u16) -> u16 {
    spread(rays, depth).min(depth / 2)
}

/// Whether a pixel sees something over a cell that is taken.
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

    /// A floor, and legs on it all over, so little before it that at five metres their noise is in the
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
    fn who_stands_on_it_now_and_then_does_not_draw_the_floor_towards_the_camera() {
        let (rays, floor, legs) = floor_and_legs();
        let taken = vec![false; rays.cells()];
        let mut background = Background::new(&rays);
        // Five images a second; two seconds of six somebody stands there.
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

    /// How many pixels between 4.5 and 5.5 m count for floor, and for something in the way.
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
    fn where_somebody_stands_who_is_hidden_by_noise_no_floor_is_seen() {
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
    fn who_stood_in_view_while_the_room_was_learnt_leaves_nothing_behind() {
        let (rays, floor, legs) = floor_and_legs();
        let taken = vec![false; rays.cells()];
        let mut background = Background::new(&rays);
        let in_the_way = |background: &Background| far(&rays, &floor, background)[1];
        // Five images a second, the last as late as each pixel has been looked at twice.
        let (leaves, ends) = (50, 50 + 2 * u64::from(ROWS_BETWEEN));
        for frame in 0..leaves {
            background.learn(
                &rays,
                &noisy(&legs, &DepthNoise::D435, frame, 980),
                Instant(frame * 200_000),
                &taken,
            );
        }
        let before = in_the_way(&background);
        for frame in leaves..ends {
            background.learn(
                &rays,
                &noisy(&floor, &DepthNoise::D435, frame, 980),
                Instant(frame * 200_000),
                &taken,
            );
        }
        let after = in_the_way(&background);
        assert!(before > 1_000 && 10 * after < before, "{before} pixels, then {after}");
    }
}
