//! The outline of what a scan saw, drawn on a window.
//!
//! The ends of the beams, in order of bearing, close a polygon with the sensor; what is inside,
//! minus the hits, is free. Invalid beams break the polygon where they leave room for a cell, and
//! where the range jumps between two beams only the nearer range is claimed between them: nothing is
//! free that no beam crossed.
//!
//! Where there are several beams to a cell, most of them end on a surface that others have shown
//! already. From each beam that is drawn on, those are passed over that end where the surface goes
//! on, within a cell, up to some cells further; in between the surface is drawn as a line.

use core::ops::AddAssign;

use ubimap_protocol::units::Millimetres;

use super::{
    policy::Policy,
    projection::{Corner, Direction, Point, Projection},
    scan_window::ScanWindow,
};
use crate::sense::{Beam, DIRECTION_BITS, Validity};

/// Two beams whose readings differ by more than this look past an edge, in millimetres.
const JUMP: u32 = 150;

/// How the readings of a scan fared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PixelCounts {
    /// All of them.
    pub seen: u32,
    /// Those that went into the map.
    pub kept: u32,
    /// Those that could have said nothing new.
    pub omitted: u32,
    /// Those without a return, or that the sensor model has no place for.
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

/// What is constant from scan to scan: millimetres, if not said otherwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Grain {
    /// Half a cell: the free space ends so much before a hit, for its cell, and its neighbours on
    /// a wall that is seen at a slant, are not free.
    margin: u32,
    /// Three quarters of a cell: what differs less is within a cell.
    tolerance: u32,
    /// Millimetres of reading times beams that fit [`SPAN`] cells side by side.
    spread: u32,
    /// How far scans are mapped at most.
    reach: Reach,
    /// Millimetres of reading times beams that fit half a cell.
    bridge: u32,
    /// Readings from the first on, so many more, may count.
    counting: (u32, u32),
    /// They do if they are so near to the one before; negative if that alone does not do.
    touch: i32,
    /// Which readings count.
    validity: Validity,
}

/// How far a scan is mapped: millimetres.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Reach {
    /// From the sensor, whatever a beam's reading means.
    pub(super) range: u16,
    /// Readings up to this one are within it, whatever their beam.
    surely: u32,
    /// Those from this one on are beyond it, whatever their beam.
    beyond: u32,
}

impl Reach {
    /// This reach, but no farther than `range`.
    fn within(self, range: u16) -> Self {
        let scale = f32::from(range) / f32::from(self.range);
        // Off by less than one.
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

/// Cells that are passed over at most, across the beams.
const SPAN: u32 = 16;
/// Beams that are looked at among those that are passed over: three in two cells.
const CHECKS: usize = SPAN as usize * 3 / 2;

impl Grain {
    /// For the table of a sensor.
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
        let more = u32::from(validity.farthest).checked_sub(first);
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
        }
    }

    /// The same for scans that are mapped up to a shorter `range`; `None` if it is not shorter.
    pub(super) fn within(&self, range: u16) -> Option<Self> {
        (range < self.reach.range).then(|| Self { reach: self.reach.within(range), ..*self })
    }

    /// The range up to which scans are mapped, in millimetres.
    pub(super) fn range(&self) -> u16 {
        self.reach.range
    }

    /// Whether a reading counts, and is farther than the margin.
    #[inline(always)]
    fn counts(&self, readings: &[u16], index: usize, reading: u16) -> bool {
        let (first, more) = self.counting;
        let is_apart = |&before: &u16| i32::from(before.abs_diff(reading)) > self.touch;
        u32::from(reading).wrapping_sub(first) <= more
            && (!readings.get(index.wrapping_sub(1)).is_none_or(is_apart)
                || self.validity.counts_at(readings, index, reading))
    }

    /// Within a radian, in millimetres: a robot that stands before a wall sees it bend.
    #[inline(always)]
    fn near(&self) -> u32 {
        2 * SPAN * self.margin
    }

    /// Whether a gap of so many beams is too narrow for a cell that no beam crosses. Near the robot, which
    /// goes there next, half a cell is wide enough.
    #[inline(always)]
    fn bridges(&self, beams: u32, range: u32) -> bool {
        let bridge = if range > self.near() { 2 * self.bridge } else { self.bridge };
        beams.wrapping_mul(range) <= bridge
    }

    /// How far a surface goes on in a line, to `end` at most, from a beam on that ends on it. One
    /// beam in some is looked at, and those between the last of them and the next. The first of
    /// them says how the line goes, if what lies half way is on it too.
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

    /// The last beam that ends within the range on a surface that leaves it, from a beam within it on.
    /// So many steps further it is still the surface; the beams in between may look at something else.
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

    /// The last beam before `end` up to which nothing is in range, from one on that reaches so far, or
    /// the next one if a surface comes into it within a cell. One beam in some is looked at, and those
    /// after the last of them.
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

/// A part of a scan: beams, and as many readings.
#[derive(Clone, Copy)]
pub(super) struct Part<'s> {
    pub(super) beams: &'s [Beam],
    pub(super) readings: &'s [u16],
    /// Whether the first beam was the last one of the part before.
    pub(super) is_continued: bool,
}

/// Draws a part of a scan. Returns the nearest hit, in millimetres of reading.
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
    // As if an end at the sensor itself came before.
    let mut last = End { index: 0, reach: 0, at: sensor, hit: None };
    // Whether there is an invalid beam behind the last end.
    let mut is_broken = true;
    let mut index = 0;
    while let Some((&reading, &beam)) = readings.get(index).zip(beams.get(index)) {
        if !grain.counts(readings, index, reading) || beam == Beam::NONE {
            let gap = gap(readings, index);
            invalid += gap as u32;
            is_first_invalid |= index == 0;
            index += gap;
            is_broken = true;
            continue;
        }
        let reading = u32::from(reading);
        let is_hit = grain.reach.has(beam, reading);
        let reach =
            if is_hit { reading - grain.margin } else { beam.reading_at(grain.reach.range) };
        kept += 1;
        let direction = projection.direction(beam);
        let at = projection.corner(direction, reach);
        let next = Next { direction, reach, passed: index - last.index, is_broken };
        let (from, continues) = join(window, (projection, sensor), grain, beams, &last, next);
        window.edge(from, at);
        let mut hit = None;
        if is_hit {
            let to = projection.point(direction, reading);
            if let Some(surface) = last.hit.filter(|_| continues) {
                window.surface(surface, to, next.passed as i32);
            }
            window.hit(to);
            nearest = nearest.min(reading);
            hit = Some(to);
        }
        is_broken = false;
        last = End { index, reach, at, hit };
        // Passes over beams that end on the same surface, or are out of range as this one is. Not a
        // function of its own: that costs 5 % of a row's instructions.
        let here = index;
        index += 1;
        let ahead = grain.spread.checked_div(reach.max(grain.near())).unwrap_or(0) as usize;
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
                // A surface that leaves the range.
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
        } else {
            let way = (here, here + ahead, stride);
            index = index.max(grain.nothing_up_to((beams, readings), way, reach));
        }
    }
    window.edge(last.at, sensor);
    let seen = (readings.len() as u32).saturating_sub(u32::from(is_continued));
    // The first one has been counted with the part before.
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

/// The beam after the last end.
#[derive(Clone, Copy)]
struct Next {
    direction: Direction,
    /// The part of its reading that is free.
    reach: u32,
    /// Number of beams since the last end.
    passed: usize,
    /// Whether an invalid beam lies between.
    is_broken: bool,
}

/// Draws from the last end to where the edge to the next one starts: at the last end if the gap is too
/// narrow for a cell, else at the sensor. Returns that corner, and whether the last surface continues.
#[inline(always)]
fn join(
    window: &mut ScanWindow<'_>,
    (projection, sensor): (&Projection, Corner),
    grain: &Grain,
    beams: &[Beam],
    last: &End,
    next: Next,
) -> (Corner, bool) {
    let least = last.reach.min(next.reach);
    if next.is_broken && !grain.bridges(next.passed as u32, least) {
        window.edge(last.at, sensor);
        return (sensor, false);
    }
    if !(next.is_broken || next.passed == 1) || last.reach.abs_diff(next.reach) <= JUMP {
        return (last.at, true);
    }
    // Only the nearer range is claimed between them.
    let mut step = next.direction;
    if last.reach >= next.reach
        && let Some(&beam) = beams.get(last.index)
    {
        step = projection.direction(beam);
    }
    let step = projection.corner(step, least);
    window.edge(last.at, step);
    (step, false)
}
