//! The outline of what a scan saw, drawn on a window.
//!
//! The ends of the beams, in order of bearing, close a polygon with the sensor; what is inside,
//! minus the hits, is free. Invalid beams break the polygon, and where the range jumps between two
//! beams only the nearer range is claimed between them: nothing is free that no beam crossed.
//!
//! Where there are several beams to a cell, most of them end on a surface that others have shown
//! already. From each beam that is drawn on, those are passed over that end where the surface goes
//! on, within a cell, up to some cells further; in between the surface is drawn as a line.

use core::ops::AddAssign;

use ubimap_protocol::units::Millimetres;

use super::{
    policy::Policy,
    projection::{Point, Projection},
    window::Window,
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
    /// The range of the map.
    range: u16,
    /// Readings up to this one are within it, whatever their beam.
    surely: u32,
    /// Which readings count.
    validity: Validity,
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
        let surely = used.map(|beam| beam.reading_at(range)).min().unwrap_or(0).saturating_sub(1);
        let side = side.0.clamp(0, 10_000) as u32;
        let span = if policy == Policy::Full { SPAN } else { 0 };
        Self {
            margin: side / 2,
            tolerance: side * 3 / 4,
            spread: ((span * side) << DIRECTION_BITS) / widest,
            range,
            surely,
            validity,
        }
    }
}

/// One end of the polygon.
#[derive(Clone, Copy)]
struct End {
    index: usize,
    /// What of the reading is free.
    reach: u32,
    at: Point,
    hit: Option<Point>,
}

/// Draws a part of a scan. `continued`: the first beam was the last one of the part before.
/// Returns the nearest hit, in millimetres of reading.
#[inline(never)]
pub(super) fn trace(
    window: &mut Window<'_>,
    projection: &Projection,
    grain: Grain,
    beams: &[Beam],
    readings: &[u16],
    continued: bool,
    pixels: &mut PixelCounts,
) -> u32 {
    let sensor = projection.origin();
    let range_square = u64::from(grain.range).pow(2) << (2 * DIRECTION_BITS);
    let (mut kept, mut invalid, mut nearest) = (0, 0, u32::MAX);
    let mut last: Option<End> = None;
    let mut index = 0;
    while let Some((&reading, &beam)) = readings.get(index).zip(beams.get(index)) {
        let counts = grain.validity.counts_at(readings, index, reading);
        let reading = u32::from(reading);
        if !counts || reading <= grain.margin || beam == Beam::NONE {
            // Where nothing comes back, often much does not.
            let rest = readings.get(index + 1..).unwrap_or_default();
            let gap = 1 + rest.iter().take_while(|&&reading| reading == 0).count();
            invalid += gap as u32 - u32::from(index == 0 && continued);
            index += gap;
            if let Some(end) = last.take() {
                window.edge(end.at, sensor);
            }
            continue;
        }
        let is_hit = reading <= grain.surely
            || u64::from(reading * reading) * u64::from(beam.square()) <= range_square;
        let reach = if is_hit { reading - grain.margin } else { beam.reading_at(grain.range) };
        kept += u32::from(index > 0 || !continued);
        let direction = projection.direction(beam);
        let at = projection.point(direction, reach);
        let hit = is_hit.then(|| projection.point(direction, reading));
        // By how much the reading changes from beam to beam, as far as known: 8 fractional bits.
        let mut slope = 0;
        let mut from = sensor;
        let mut surface = hit;
        let mut passed = 1;
        if let Some(before) = last {
            from = before.at;
            if before.index + 1 == index && before.reach.abs_diff(reach) > JUMP {
                // Only the nearer range is claimed between them.
                let step = match before.reach < reach {
                    true => projection.point(direction, before.reach),
                    false => {
                        let beam = beams.get(before.index).copied().unwrap_or(beam);
                        projection.point(projection.direction(beam), reach)
                    }
                };
                window.edge(from, step);
                from = step;
            } else if before.hit.is_some() {
                surface = before.hit;
                passed = (index - before.index) as i32;
                slope = ((reach as i32 - before.reach as i32) << 8) / passed.max(4);
            }
        }
        window.edge(from, at);
        if let (Some(hit), Some(surface)) = (hit, surface) {
            window.surface(surface, hit, passed);
            nearest = nearest.min(reading);
        }
        last = Some(End { index, reach, at, hit });

        // Where the surface goes on, or nothing is in range, up to some cells further.
        let here = index;
        let ahead = grain.spread.checked_div(reach).unwrap_or(0) as usize;
        if ahead >= 2 * SPAN as usize {
            let stride = ahead / CHECKS + 1;
            let end = here + ahead - stride;
            let (mut expected, span, change) = match is_hit {
                true => {
                    let low = reading.saturating_sub(grain.tolerance) << 8;
                    (low, 2 * grain.tolerance, slope.wrapping_mul(stride as i32))
                }
                false => (reach << 8, u32::from(u16::MAX), 0),
            };
            let goes_on = |index: usize, expected: u32| {
                let next = readings.get(index);
                next.is_some_and(|&next| u32::from(next).wrapping_sub(expected >> 8) <= span)
            };
            let mut next = expected.wrapping_add_signed(change);
            while index <= end && goes_on(index + stride, next) {
                index += stride;
                expected = next;
                next = expected.wrapping_add_signed(change);
            }
            let rest = readings.get(index + 1..readings.len().min(end + 2)).unwrap_or_default();
            let low = expected >> 8;
            for &next in rest {
                if u32::from(next).wrapping_sub(low) > span {
                    break;
                }
                index += 1;
            }
        }
        index = index.max(here + 1);
    }
    if let Some(end) = last {
        window.edge(end.at, sensor);
    }
    let seen = (readings.len() as u32).saturating_sub(u32::from(continued));
    *pixels += PixelCounts { seen, kept, omitted: seen.saturating_sub(kept + invalid), invalid };
    nearest
}
