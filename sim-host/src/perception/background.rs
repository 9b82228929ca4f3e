//! What each pixel of a camera sees when nobody is there: learnt in the first seconds, and anew
//! where it changes for good.
//!
//! A pixel agrees with its background if its depth is within a window, learnt as well. It then
//! counts for the cell in which the *learnt* point is, so that noise does not smear what stands
//! still; which cell that is, is found once. Learning also takes up what calibration leaves: a floor
//! that is a centimetre off, a threshold, a carpet.

use ubimap_protocol::time::{Duration, Instant};

use super::view::{Allowance, Place, View, noise_mm};

/// Depths of each pixel that are learnt from, and the time from one to the next.
const SAMPLES: usize = 15;
const SAMPLE_INTERVAL: Duration = Duration::from_millis(300);
/// A pixel that measured less often has no background.
const FEWEST_SAMPLES: usize = 8;
/// One in so many samples may be a passer-by on each side of the window.
const TRIM: usize = 5;
/// Added to what noise explains, in millimetres: quantisation.
const SLACK_MM: i64 = 4;
/// After a frame, one row in so many is looked at for changes that last.
const ROWS_BETWEEN: u32 = 32;
/// What is nearer than the background becomes background after so many looks and seconds without a
/// change; what is farther was hidden until now, and becomes it sooner.
const STAY: (u8, u32) = (3, 20);
const UNCOVERED: (u8, u32) = (2, 2);

/// A depth that may become the background of a pixel.
#[derive(Clone, Copy, Debug, Default)]
struct Candidate {
    depth: u16,
    looks: u8,
    /// Whether the present background came after the first was learnt.
    has_come: bool,
    since_s: u32,
}

/// The background of one camera.
#[derive(Clone, Debug)]
pub struct Background {
    /// In millimetres; zero where there is none.
    depth: Vec<u16>,
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
    pub fn new(view: &View) -> Self {
        let pixels = view.pixels();
        let nowhere = 2 * view.cells();
        let mut totals = vec![0; nowhere + 2];
        totals[nowhere + 1] = pixels as u32;
        Self {
            depth: vec![0; pixels],
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
    pub fn learn(&mut self, view: &View, depths: &[u16], captured: Instant, taken: &[bool]) {
        let Some(samples) = &mut self.samples else {
            return self.tend(view, depths, captured, taken);
        };
        if captured < self.due {
            return;
        }
        self.due = captured + SAMPLE_INTERVAL;
        let sample = |(pixel, &depth): (usize, &u16)| {
            if is_taken(view, pixel, depth, taken) { 0 } else { depth }
        };
        samples.extend(depths.iter().enumerate().map(sample));
        if samples.len() >= SAMPLES * depths.len() {
            let samples = self.samples.take().unwrap_or_default();
            self.settle_all(view, &samples);
        }
    }

    /// The lowest depth of each pixel's window, and how much more the highest is.
    pub(super) fn windows(&self) -> (&[u16], &[u16]) {
        (&self.low, &self.span)
    }

    pub(super) fn totals(&self) -> &[u32] {
        &self.totals
    }

    pub(super) fn home(&self, pixel: usize) -> usize {
        self.home[pixel] as usize
    }

    pub(super) fn agrees(&self, pixel: usize, depth: u16) -> bool {
        depth.wrapping_sub(self.low[pixel]) <= self.span[pixel]
    }

    /// Whether a depth is nearer than the background.
    pub(super) fn is_nearer(&self, pixel: usize, depth: u16) -> bool {
        depth > 0 && depth < self.low[pixel]
    }

    /// What a pixel counts for where it agrees, as [`Background::home`] has it, found anew.
    pub(super) fn settle(&self, view: &View, pixel: usize) -> u32 {
        let slot = match view.place(pixel, self.depth[pixel], Allowance::Learnt) {
            Place::Floor(cell) => 2 * cell as usize,
            Place::Band(cell, _) => 2 * cell as usize + 1,
            // What has come stands on the floor; what was always there may hang.
            Place::Above(cell, _) if self.candidates[pixel].has_come => 2 * cell as usize + 1,
            Place::Above(..) | Place::Nowhere => self.totals.len() - 1,
        };
        slot as u32
    }

    /// Ends the learning: the median of each pixel's samples, and the window that most are in.
    fn settle_all(&mut self, view: &View, samples: &[u16]) {
        let pixels = self.depth.len();
        let mut seen = Vec::with_capacity(SAMPLES);
        for pixel in 0..pixels {
            seen.clear();
            seen.extend(samples.iter().skip(pixel).step_by(pixels).filter(|depth| **depth > 0));
            if seen.len() < FEWEST_SAMPLES {
                continue;
            }
            seen.sort_unstable();
            let median = seen[seen.len() / 2];
            let (low, high) = (seen[seen.len() / TRIM], seen[seen.len() - 1 - seen.len() / TRIM]);
            self.set(view, pixel, median, (low, high));
        }
    }

    /// Gives a pixel a background, and a window about what was measured of it.
    fn set(&mut self, view: &View, pixel: usize, depth: u16, (low, high): (u16, u16)) {
        // The trimmed range of samples is about 1.7 sigmas: the window has twice that on each side.
        let noise = noise_mm(i64::from(depth));
        let range = i64::from(high) - i64::from(low);
        let margin = (SLACK_MM + (3 * range / 2).clamp(noise / 2, 3 * noise)) as u16;
        let low = low.saturating_sub(margin).max(1);
        self.low[pixel] = low;
        self.span[pixel] = high.saturating_add(margin) - low;
        self.depth[pixel] = depth;
        self.totals[self.home[pixel] as usize] -= 1;
        self.home[pixel] = self.settle(view, pixel);
        self.totals[self.home[pixel] as usize] += 1;
    }

    /// Looks at some of the rows for what has changed for good.
    fn tend(&mut self, view: &View, depths: &[u16], captured: Instant, taken: &[bool]) {
        let now_s = (captured.0 / 1_000_000) as u32;
        let width = view.size().0 as usize;
        let rows = depths.chunks(width).enumerate().skip(self.turn as usize);
        for (row, depths) in rows.step_by(ROWS_BETWEEN as usize) {
            for (pixel, &depth) in (row * width..).zip(depths) {
                if depth == 0 || is_taken(view, pixel, depth, taken) {
                    continue;
                }
                if self.agrees(pixel, depth) {
                    self.candidates[pixel].looks = 0;
                } else {
                    self.consider(view, pixel, depth, now_s);
                }
            }
        }
        self.turn = (self.turn + 1) % ROWS_BETWEEN;
    }

    /// A pixel sees something else than its background.
    fn consider(&mut self, view: &View, pixel: usize, depth: u16, now_s: u32) {
        let is_nearer = self.is_nearer(pixel, depth);
        let candidate = &mut self.candidates[pixel];
        let spread = (SLACK_MM + 3 * noise_mm(i64::from(depth))) as u16;
        if candidate.looks == 0 || depth.abs_diff(candidate.depth) > spread {
            *candidate = Candidate { depth, looks: 1, since_s: now_s, ..*candidate };
            return;
        }
        // The mean of the looks.
        let looks = u32::from(candidate.looks);
        let sum = u32::from(candidate.depth) * looks + u32::from(depth);
        candidate.depth = (sum / (looks + 1)) as u16;
        candidate.looks = candidate.looks.saturating_add(1);
        let (enough, seconds) = if is_nearer { STAY } else { UNCOVERED };
        if candidate.looks >= enough && now_s.saturating_sub(candidate.since_s) >= seconds {
            candidate.looks = 0;
            candidate.has_come = is_nearer;
            let depth = candidate.depth;
            let spread = 2 * noise_mm(i64::from(depth)) as u16;
            self.set(
                view,
                pixel,
                depth,
                (depth.saturating_sub(spread), depth.saturating_add(spread)),
            );
        }
    }
}

/// Whether a pixel sees something over a cell that is taken.
fn is_taken(view: &View, pixel: usize, depth: u16, taken: &[bool]) -> bool {
    match view.place(pixel, depth, Allowance::Measured) {
        Place::Band(cell, _) | Place::Above(cell, _) => taken[cell as usize],
        Place::Floor(_) | Place::Nowhere => false,
    }
}
