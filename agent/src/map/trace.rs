//! Draws the outline of a scan's free space on a window.
//!
//! The ends of the beams, in order of bearing, and the sensor form a polygon; its interior, minus
//! the hits, is free. Free space ends half a cell before a hit (`Grain::margin`). Invalid beams
//! break the polygon where the gap is wide enough for a cell. Where the range jumps between two
//! beams, the space between them is free only up to the nearer of the two ranges: no cell becomes
//! free that no beam crossed.
//!
//! Where several beams fall into a cell, most of them hit a surface that other beams already show.
//! After each drawn beam, beams are skipped while they end within a cell of the straight
//! continuation of its surface, for up to [`SPAN`] cells; the surface in between is drawn as a
//! line.

use core::ops::AddAssign;

use ubimap_protocol::units::Millimetres;

use super::{
    policy::Policy,
    projection::{Corner, Point, Projection},
    scan_window::ScanWindow,
};
use crate::sense::{Beam, DIRECTION_BITS, NOTHING_IN_RANGE, Validity};

/// Maximum difference between two adjacent readings that belong to one surface, in millimetres.
const JUMP: u32 = 150;

/// Counts of a scan's readings.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PixelCounts {
    /// All readings.
    pub seen: u32,
    /// Readings that were mapped.
    pub kept: u32,
    /// Readings skipped as redundant.
    pub omitted: u32,
    /// Readings that are missing, invalid, or of removed beams.
    pub invalid: u32,
}

impl AddAssign for PixelCounts {
    fn add_assign(&mut self, other: Self) {
        self.seen = self.seen.wrapping_add(other.seen);
        self.kept = self.kept.wrapping_add(other.kept);
        self.omitted = self.omitted.wrapping_add(other.omitted);
        self.invalid = self.invalid.wrapping_add(other.invalid);
    }
}

/// Parameters that are constant from scan to scan, in millimetres unless stated otherwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Grain {
    /// Half a cell: free space ends this far before a hit, because its cell is not free, nor are
    /// the adjacent cells on a slanted wall.
    margin: u32,
    /// Three quarters of a cell: the maximum deviation within a surface.
    tolerance: u32,
    /// A number of adjacent beams spans [`SPAN`] cells sideways if the number times their reading
    /// (mm) is this product.
    spread: u32,
    /// Range limit of the mapping.
    reach: Reach,
    /// The same product for a number of beams that spans half a cell.
    bridge: u32,
    /// The first valid reading, and the length of the interval of valid readings.
    counting: (u32, u32),
    /// Maximum difference to the previous reading for which no further check is needed; negative if
    /// it is always needed.
    touch: i32,
    /// Which readings are valid.
    validity: Validity,
    /// Distance up to which beams with nothing in range are free, in millimetres; 0 if they are left out.
    clear: u16,
}

/// The mapped range, in millimetres.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Reach {
    /// Distance from the sensor.
    pub(super) range: u16,
    /// Readings up to this one are within the range for every beam.
    surely: u32,
    /// Readings from this one on are beyond the range for every beam.
    beyond: u32,
}

impl Reach {
    /// The same limits for a shorter range; the range is at most `range`.
    fn within(self, range: u16) -> Self {
        let scale = f32::from(range) / f32::from(self.range);
        // Rounds down, with an error below one.
        let part = |reading: u32| (reading as f32 * scale) as u32;
        Self {
            range,
            surely: part(self.surely).saturating_sub(1),
            beyond: part(self.beyond).saturating_add(2),
        }
    }

    /// Whether a beam ends within the range.
    #[inline(always)]
    fn has(&self, beam: Beam, reading: u32) -> bool {
        let square = u32::from(self.range) * u32::from(self.range);
        reading <= self.surely
            || u64::from(reading * reading) * u64::from(beam.square())
                <= u64::from(square) << (2 * DIRECTION_BITS)
    }
}

/// Maximum number of cells that skipped beams span.
const SPAN: u32 = 16;
/// Number of skipped beams that are checked: three per two cells.
const CHECKS: usize = SPAN as usize * 3 / 2;

impl Grain {
    /// The parameters for a sensor with this table of beams, and for cells of side `side`.
    pub(super) fn new(
        beams: &[Beam],
        side: Millimetres,
        range: u16,
        validity: Validity,
        policy: Policy,
    ) -> Self {
        let apart = beams.windows(2).map(|pair| match pair {
            [a, b] if *a != Beam::NONE && *b != Beam::NONE => {
                let across = |a: i16, b: i16| u32::from(a.abs_diff(b));
                across(a.forward, b.forward).max(across(a.left, b.left))
            }
            _ => 0,
        });
        let widest = apart.max().unwrap_or(0).max(1);
        let used = beams.iter().filter(|beam| **beam != Beam::NONE);
        let reaches = used.map(|beam| beam.reading_at(range));
        let (low, high) =
            reaches.fold((u32::MAX, 0), |(low, high), it| (low.min(it), high.max(it)));
        let surely = low.min(high).saturating_sub(1);
        let side = side.0.clamp(0, 10_000) as u32;
        let span = if policy == Policy::Full { SPAN } else { 0 };
        let spread = ((span * side) << DIRECTION_BITS) / widest;
        let margin = side / 2;
        let first = u32::from(validity.nearest).max(margin + 1);
        let farthest = validity.farthest.min(NOTHING_IN_RANGE - 1);
        let more = u32::from(farthest).checked_sub(first);
        let touch = match validity {
            _ if validity.removes() => -1,
            Validity { flying: 0, .. } => i32::MAX,
            Validity { flying, .. } => i32::from(flying),
        };
        Self {
            margin,
            tolerance: side * 3 / 4,
            spread,
            reach: Reach { range, surely, beyond: high.saturating_add(high / 1_000 + 2) },
            bridge: spread / (2 * SPAN),
            counting: more.map_or((u32::MAX, 0), |more| (first, more)),
            touch,
            validity,
            clear: 0,
        }
    }

    /// The same parameters for a scan in which beams with nothing in range are free up to `clear`.
    pub(super) fn clear_to(&self, clear: u16) -> Self {
        Self { clear: clear.min(self.reach.range), ..*self }
    }

    /// The same parameters for a scan that is mapped up to a shorter `range`; `None` if `range` is
    /// not shorter.
    pub(super) fn within(&self, range: u16) -> Option<Self> {
        (range < self.reach.range).then(|| Self { reach: self.reach.within(range), ..*self })
    }

    /// The maximum range, in millimetres.
    pub(super) fn range(&self) -> u16 {
        self.reach.range
    }

    /// Whether a reading is valid.
    #[inline(always)]
    fn counts(&self, readings: &[u16], index: usize, reading: u16) -> bool {
        let (first, more) = self.counting;
        let is_apart = |&before: &u16| i32::from(before.abs_diff(reading)) > self.touch;
        u32::from(reading).wrapping_sub(first) <= more
            && (!readings.get(index.wrapping_sub(1)).is_none_or(is_apart)
                || self.validity.counts_at(readings, index, reading))
    }

    /// The range at which [`SPAN`] cells cover one radian, in millimetres: closer, a straight wall
    /// looks bent.
    #[inline(always)]
    fn near(&self) -> u32 {
        2 * SPAN * self.margin
    }

    /// The last beam, at most `end`, up to which the surface that beam `from` hits continues in a
    /// straight line. Checks every `stride`th beam, then each beam after the last match. The first
    /// step gives the line's slope, provided that the beam halfway is on the line.
    #[inline(always)]
    fn surface_up_to(
        &self,
        readings: &[u16],
        (from, end, stride): (usize, usize, usize),
        reading: u32,
    ) -> usize {
        let within = readings.get(..end + 1).unwrap_or(readings);
        let span = 2 * self.tolerance;
        let mut low = reading.wrapping_sub(self.tolerance);
        let mut last = from;
        let at = |index: usize| within.get(index).map_or(0, |&reading| i32::from(reading));
        let mut change = at(from + stride) - reading as i32;
        let bend = change + 2 * (reading as i32 - at(from + stride / 2));
        if change.unsigned_abs() > JUMP || bend.unsigned_abs() > self.tolerance {
            change = 0;
        }
        while let Some(&reading) = within.get(last + stride)
            && u32::from(reading).wrapping_sub(low.wrapping_add_signed(change)) <= span
        {
            last += stride;
            low = low.wrapping_add_signed(change);
        }
        let rest = within.get(last + 1..).unwrap_or_default();
        let is_next = |&&next: &&u16| u32::from(next).wrapping_sub(low) <= span;
        last + rest.iter().take(stride).take_while(is_next).count()
    }

    /// The last beam within the range on a surface that leaves the range; the search starts at a
    /// beam within it. Bisects in steps of `stride` beams. The beams in between are not checked and
    /// may see something else.
    #[inline(never)]
    fn last_within(
        &self,
        (beams, readings): (&[Beam], &[u16]),
        (from, stride, steps): (usize, usize, usize),
    ) -> usize {
        let reading = |index: usize| readings.get(index).copied().unwrap_or(0);
        let is_within = |index: usize| {
            beams.get(index).is_some_and(|&beam| self.reach.has(beam, reading(index).into()))
        };
        let (mut within, mut beyond) = (0, steps + 1);
        while beyond - within > 1 {
            let middle = (within + beyond) / 2;
            let place = if is_within(from + middle * stride) { &mut within } else { &mut beyond };
            *place = middle;
        }
        let last = from + within * stride;
        let is_next = |&index: &usize| {
            u32::from(reading(index).abs_diff(reading(last))) <= self.tolerance && is_within(index)
        };
        last + (last + 1..last + stride).take_while(is_next).count()
    }

    /// The last beam before `end` up to which every beam is out of range, starting from `from`,
    /// which is; or the beam after it, if the surface enters the range within a cell there. Checks
    /// every `stride`th beam, then each beam after the last match.
    #[inline(never)]
    fn nothing_up_to(
        &self,
        (beams, readings): (&[Beam], &[u16]),
        (from, end, stride): (usize, usize, usize),
        farthest: u32,
    ) -> usize {
        let mut last = from;
        let mut stride = stride;
        loop {
            let index = last + stride;
            let Some((&beam, &reading)) = beams.get(index).zip(readings.get(index)) else {
                return last;
            };
            let reading = u32::from(reading);
            if index < end
                && reading.wrapping_sub(self.counting.0) <= self.counting.1
                && (reading >= self.reach.beyond || !self.reach.has(beam, reading))
            {
                last = index;
            } else if stride > 1 {
                stride = 1;
            } else {
                let comes_in = index < end
                    && reading + self.tolerance > farthest
                    && self.counts(readings, index, reading as u16);
                return if comes_in { index } else { last };
            }
        }
    }
}

/// A part of a scan: beams and their readings.
#[derive(Clone, Copy)]
pub(super) struct Part<'s> {
    pub(super) beams: &'s [Beam],
    pub(super) readings: &'s [u16],
    /// Whether the first beam was the last one of the previous part.
    pub(super) is_continued: bool,
}

/// Draws a part of a scan, and adds the counts of its readings to `pixels`. Returns the reading of
/// the nearest hit in millimetres, or `u32::MAX` if there is none.
#[inline(never)]
pub(super) fn trace(
    window: &mut ScanWindow<'_>,
    projection: &Projection,
    grain: &Grain,
    part: Part<'_>,
    pixels: &mut PixelCounts,
) -> u32 {
    let Part { beams, readings, is_continued } = part;
    let sensor = projection.sensor();
    let (mut kept, mut invalid, mut nearest) = (0_u32, 0_u32, u32::MAX);
    let mut is_first_invalid = false;
    // The outline starts at the sensor.
    let mut last = End { index: 0, reach: 0, at: sensor, hit: None };
    // Whether an invalid beam followed the last end.
    let mut is_broken = true;
    let near = grain.near();
    let mut index = 0;
    while let Some((&reading, &beam)) = readings.get(index).zip(beams.get(index)) {
        // What is no distance may say that there is nothing.
        let is_silent = || reading != NOTHING_IN_RANGE || grain.clear == 0;
        if !grain.counts(readings, index, reading) && is_silent() || beam == Beam::NONE {
            let gap = gap(readings, index);
            invalid += gap as u32;
            is_first_invalid |= index == 0;
            index += gap;
            is_broken = true;
            continue;
        }
        let reading = u32::from(reading);
        // Nothing in range is beyond any range.
        let is_hit = grain.reach.has(beam, reading);
        let is_nothing = || reading == NOTHING_IN_RANGE.into();
        let reach = if is_hit {
            reading - grain.margin
        } else {
            beam.reading_at(if is_nothing() { grain.clear } else { grain.reach.range })
        };
        kept += 1;
        let direction = projection.direction(beam);
        let at = projection.corner(direction, reach);
        // Joins the ends. Neither this nor the skipping below is a function of its own: together,
        // the calls would cost 5 % of a row's instructions.
        let passed = index - last.index;
        let least = last.reach.min(reach);
        let mut from = sensor;
        let mut surface = None;
        // Invalid beams break the outline unless the gap is too narrow to contain a cell that no
        // beam crosses. Near the robot, half that width is allowed.
        let bridge = if least > near { 2 * grain.bridge } else { grain.bridge };
        if is_broken && (passed as u32).wrapping_mul(least) > bridge {
            window.edge(last.at, sensor);
        } else {
            from = last.at;
            if (is_broken || passed == 1) && last.reach.abs_diff(reach) > JUMP {
                // Between the two beams, space is free only up to the nearer range.
                let mut step = direction;
                if last.reach >= reach
                    && let Some(&beam) = beams.get(last.index)
                {
                    step = projection.direction(beam);
                }
                let step = projection.corner(step, least);
                window.edge(from, step);
                from = step;
            } else {
                surface = last.hit;
            }
        }
        window.edge(from, at);
        let mut hit = None;
        if is_hit {
            let to = projection.point(direction, reading);
            if let Some(surface) = surface {
                window.surface(surface, to, passed as i32);
            }
            window.hit(to);
            nearest = nearest.min(reading);
            hit = Some(to);
        }
        is_broken = false;
        last = End { index, reach, at, hit };
        // Skips beams that end on the same surface, or that are out of range like this one.
        let here = index;
        index += 1;
        let ahead = grain.spread.checked_div(reach.max(near)).unwrap_or(0) as usize;
        if ahead < 2 * SPAN as usize {
            continue;
        }
        let stride = ahead / CHECKS + 1;
        if is_hit {
            let end = grain.surface_up_to(readings, (here, here + ahead, stride), reading);
            index = index.max(end);
            if let Some((&beam, &reading)) = beams.get(end).zip(readings.get(end))
                && !grain.reach.has(beam, reading.into())
            {
                // The surface may leave the range.
                let way = (here, stride, (end - here) / stride);
                let end = grain.last_within((beams, readings), way);
                if let Some(((&beam, &reading), from)) =
                    beams.get(end).zip(readings.get(end)).zip(last.hit)
                {
                    let to = projection.point(projection.direction(beam), reading.into());
                    window.surface(from, to, (end - here) as i32);
                    window.hit(to);
                }
            }
        } else if !is_nothing() {
            let way = (here, here + ahead, stride);
            index = index.max(grain.nothing_up_to((beams, readings), way, reach));
        }
    }
    window.edge(last.at, sensor);
    let seen = (readings.len() as u32).saturating_sub(u32::from(is_continued));
    // The first beam was counted with the previous part.
    let again = if is_first_invalid { &mut invalid } else { &mut kept };
    *again = again.saturating_sub(u32::from(is_continued));
    *pixels += PixelCounts { seen, kept, omitted: seen.saturating_sub(kept + invalid), invalid };
    nearest
}

/// Number of invalid readings from `index` on: that one, and those without a return that follow.
#[inline(always)]
fn gap(readings: &[u16], index: usize) -> usize {
    // Beams without a return often come in long runs.
    let rest = readings.get(index + 1..).unwrap_or_default();
    let (fours, _) = rest.as_chunks();
    let gap = 4 * fours.iter().take_while(|four| **four == [0; 4]).count();
    let rest = rest.get(gap..).unwrap_or_default();
    gap + 1 + rest.iter().take_while(|&&reading| reading == 0).count()
}

/// A corner of the polygon where a beam ends.
#[derive(Clone, Copy)]
struct End {
    index: usize,
    /// The part of the reading that is free.
    reach: u32,
    at: Corner,
    hit: Option<Point>,
}
