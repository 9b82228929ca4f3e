//! The part of the grid on which a sector of a scan is drawn.
//!
//! Free space is not carved ray by ray. Each edge of a polygon flips one cell in every row of cells
//! that it crosses; the running XOR along a row is then the interior, 32 cells at a time.

use core::ops::Range;

use ubimap_protocol::tile::{TILE_SIDE, TileId};

use super::{
    evidence::RowSighting,
    projection::{Corner, Direction, FRACTION, Point, Projection},
};
use crate::sense::Beam;

/// Margin between the outermost cells that a beam can touch and the side of the window, in cells.
const RIM: i32 = 2;

/// Number of bits of a coordinate that give the position within a column of tiles.
const COLUMN: u32 = FRACTION + TILE_SIDE.ilog2();

/// Edges that cross fewer rows are drawn faster row by row.
const FEW_ROWS: i32 = 8;

/// Number of arcs into which a part of a scan is divided to find its extent.
const ARCS: usize = 4;

/// Number of words of a window that holds any eighth of a turn of a scan with this radius in cells:
/// 340 (2.7 kB, two planes) for 80.
pub(super) const fn words_of(radius: usize) -> usize {
    let across = radius + 2 * RIM as usize + 1;
    across * ((across + TILE_SIDE - 2) / TILE_SIDE + 1)
}

/// A rectangle of the grid: whole columns of tiles wide, any number of rows of cells high.
#[derive(Debug)]
pub(super) struct ScanWindow<'s> {
    /// Words of cells, one column of tiles after another from the west, each from south to north.
    cells: &'s mut [RowSighting],
    /// The westernmost column of tiles, and the number of columns.
    west: i32,
    width: usize,
    /// The southernmost row of cells, and the number of rows.
    south: i32,
    rows: usize,
}

impl<'s> ScanWindow<'s> {
    /// A window around everything that these beams can reach within a range (millimetres). `memory`
    /// must hold no observation. `None` if `memory` is too small.
    pub(super) fn over(
        beams: &[Beam],
        range: u16,
        projection: &Projection,
        memory: &'s mut [RowSighting],
    ) -> Option<Self> {
        let Sector { low, high, .. } = Sector::of(beams, range, projection);
        let cell = |(x, y): Point| (x >> FRACTION, y >> FRACTION);
        let (low, high) = (cell(low), cell(high));
        let (cell_x, cell_y) = projection.cell();
        let tile = |x: i32| x.wrapping_add(cell_x) >> TILE_SIDE.ilog2();
        let west = tile(low.0 - RIM);
        let width = usize::try_from(tile(high.0 + RIM).wrapping_sub(west)).ok()? + 1;
        let rows = usize::try_from(high.1 - low.1 + 2 * RIM + 1).ok()?;
        let cells = memory.get_mut(..rows.checked_mul(width)?)?;
        let south = cell_y.wrapping_add(low.1 - RIM);
        Some(Self { cells, west, width, south, rows })
    }

    /// The grid coordinates of the south-western cell.
    pub(super) fn corner(&self) -> (i32, i32) {
        (self.west << TILE_SIDE.ilog2(), self.south)
    }

    /// Whether the whole window is within the map's coordinates.
    pub(super) fn is_on_the_map(&self) -> bool {
        let (x, y) = self.corner();
        let far = |from: i32, cells: usize| i32::try_from(cells).ok()?.checked_add(from);
        let far = far(x, self.width * TILE_SIDE).zip(far(y, self.rows));
        let near = TileId::of_cell(x, y);
        near.is_some() && far.is_some_and(|(x, y)| TileId::of_cell(x, y).is_some())
    }

    /// Marks the cells of a surface between two points as hit. The points are relative to the
    /// window's corner, and hit by beams that are `beams` beams apart.
    #[inline(always)]
    pub(super) fn surface(&mut self, from: Point, to: Point, beams: i32) {
        let (run, rise) = (to.0 - from.0, to.1 - from.1);
        let cells = (run.abs().max(rise.abs()) >> FRACTION).min(beams);
        if cells > 1 {
            self.surface_of(from, (run / cells, rise / cells), cells - 1);
        }
    }

    /// Marks `cells` cells as hit, advancing by one step from the given point before each of them.
    #[inline(never)]
    fn surface_of(&mut self, (mut x, mut y): Point, (step_x, step_y): Point, cells: i32) {
        for _ in 0..cells {
            (x, y) = (x + step_x, y + step_y);
            self.hit((x, y));
        }
    }

    /// Marks the cell of a point as hit.
    #[inline(always)]
    pub(super) fn hit(&mut self, (x, y): Point) {
        let column = (x >> FRACTION) as u32;
        if let Some(cells) = self.word((y >> FRACTION) as usize, column) {
            cells.hit |= 1 << (column % TILE_SIDE as u32);
        }
    }

    /// Flips the free bit of a cell.
    #[inline(always)]
    fn flip(&mut self, row: usize, column: u32) {
        if let Some(cells) = self.word(row, column) {
            cells.free ^= 1 << (column % TILE_SIDE as u32);
        }
    }

    #[inline(always)]
    fn word(&mut self, row: usize, column: u32) -> Option<&mut RowSighting> {
        let index = (column as usize / TILE_SIDE).wrapping_mul(self.rows).wrapping_add(row);
        self.cells.get_mut(index)
    }

    /// For every row whose centre line the edge crosses, flips the first cell whose centre is at
    /// the crossing or east of it.
    #[inline(always)]
    pub(super) fn edge(&mut self, a: Corner, b: Corner) {
        if (a.1 ^ b.1) >> FRACTION != 0 {
            self.cross(a, b);
        }
    }

    #[inline(never)]
    fn cross(&mut self, a: Corner, b: Corner) {
        let (low, high) = if a.1 <= b.1 { (a, b) } else { (b, a) };
        let (first, last) = (low.1 >> FRACTION, high.1 >> FRACTION);
        // The distances north to the first crossing, and from one crossing to the next.
        let up = !low.1 & ((1 << FRACTION) - 1);
        let (run, rise) = (high.0 - low.0, (high.1 - low.1) as u32);
        let part = (run >> 6).wrapping_mul(up >> 6) / ((rise >> 6) as i32 + 1);
        let x = low.0.wrapping_add(part << 6);
        if last - first == 1 {
            return self.flip(first as usize, (x >> FRACTION) as u32);
        }
        let step = (((run >> 8) << 12) / (rise >> 8).max(1) as i32) << 4;
        // The column counted from the east is the number of positions by which its bit is rotated
        // from the last bit.
        let mut from_east = !x;
        if last - first < FEW_ROWS {
            for row in first..last {
                self.flip(row as usize, (!from_east >> FRACTION) as u32);
                from_east = from_east.wrapping_sub(step);
            }
            return;
        }
        let mut row = first;
        while row < last {
            // The number of rows crossed within one column of tiles.
            let room = (if step < 0 { !from_east } else { from_east }) & ((1 << COLUMN) - 1);
            let rows = (room as u32 / step.unsigned_abs().max(1) + 1).min((last - row) as u32);
            let column = !(from_east >> COLUMN) as usize;
            let start = column.wrapping_mul(self.rows).wrapping_add(row as usize);
            let cells =
                self.cells.get_mut(start..).and_then(|cells| cells.get_mut(..rows as usize));
            for cells in cells.unwrap_or_default() {
                cells.free ^= (1u32 << 31).rotate_right((from_east >> FRACTION) as u32);
                from_east = from_east.wrapping_sub(step);
            }
            row += rows as i32;
        }
    }

    /// Calls `take` with the observations of each tile: one column of tiles after another from the
    /// west, each from south to north. A call must read its piece completely: an interior that
    /// reaches the eastern side of a piece continues in the next column.
    pub(super) fn for_each_piece(&mut self, mut take: impl FnMut(Piece<'_>)) {
        let Self { west, south, rows, .. } = *self;
        let mut beyond = [RowSighting::default(); TILE_SIDE];
        let mut rest = &mut *self.cells;
        for x in west.. {
            let Some((column, east)) = rest.split_at_mut_checked(rows.max(1)) else { break };
            let mut y = south;
            let mut start = 0;
            while start < rows {
                let first_row = y as usize % TILE_SIDE;
                let end = rows.min(start + TILE_SIDE - first_row);
                let east = east.get_mut(start..end).unwrap_or(&mut beyond);
                if let Some(rows) = column.get_mut(start..end) {
                    let id = TileId { x: x as i16, y: (y >> TILE_SIDE.ilog2()) as i16 };
                    take(Piece { id, first_row, rows, east });
                }
                y = y.wrapping_add((end - start) as i32);
                start = end;
            }
            rest = east;
        }
    }
}

/// The extent of a group of beams.
struct Sector<'p> {
    projection: &'p Projection,
    range: u16,
    /// The south-western and north-eastern corner of the rectangle that contains all beams added so
    /// far.
    low: Point,
    high: Point,
    /// The direction of the last beam.
    last: Direction,
}

impl<'p> Sector<'p> {
    fn of(beams: &[Beam], range: u16, projection: &'p Projection) -> Self {
        let (low, high) = (projection.origin(), projection.origin());
        let mut sector = Self { projection, range, low, high, last: Direction::default() };
        let is_used = |beam: &&Beam| **beam != Beam::NONE;
        for arc in 0..=ARCS {
            let place = beams.len() * arc / ARCS;
            let Some((before, after)) = beams.split_at_checked(place) else { break };
            let goes_on = arc > 0 && after.first().is_some_and(|beam| is_used(&beam));
            if !goes_on && let Some(&beam) = before.iter().rfind(is_used) {
                sector.turn(beam);
                sector.end(beam);
            }
            match after.iter().find(is_used) {
                Some(&beam) if goes_on => sector.turn(beam),
                Some(&beam) => sector.end(beam),
                None => {}
            }
        }
        sector
    }

    /// Adds the end point of a beam that is the first or the last of a run of used beams.
    #[inline(never)]
    fn end(&mut self, beam: Beam) {
        let Self { projection, low, high, .. } = self;
        self.last = projection.direction(beam);
        let (x, y) = projection.point(self.last, beam.reading_at(self.range));
        *low = (low.0.min(x), low.1.min(y));
        *high = (high.0.max(x), high.1.max(y));
    }

    /// Extends the sector to a beam less than half a turn away. Between two beams, the extremes are
    /// where the arc crosses an axis.
    #[inline(never)]
    fn turn(&mut self, beam: Beam) {
        let to = self.projection.direction(beam);
        let from = core::mem::replace(&mut self.last, to);
        let ((x, y), radius) = (self.projection.origin(), self.projection.length(self.range));
        if (from.0 ^ to.0) < 0 {
            if from.1 + to.1 < 0 { self.low.1 = y - radius } else { self.high.1 = y + radius }
        }
        if (from.1 ^ to.1) < 0 {
            if from.0 + to.0 < 0 { self.low.0 = x - radius } else { self.high.0 = x + radius }
        }
    }
}

/// A word in which the `columns` westernmost columns are set, at most 32.
pub(super) fn below(columns: u32) -> u32 {
    ((1u64 << columns) - 1) as u32
}

/// The part of a tile that lies in a window: a range of rows.
#[derive(Debug)]
pub(super) struct Piece<'w> {
    /// The tile's id.
    pub(super) id: TileId,
    /// The first row of the tile that lies in the window.
    pub(super) first_row: usize,
    rows: &'w mut [RowSighting],
    /// The rows of the next tile to the east.
    east: &'w mut [RowSighting],
}

impl<'w> Piece<'w> {
    /// Number of rows.
    pub(super) fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether the piece has no observation.
    pub(super) fn says_nothing(&self) -> bool {
        let (fours, rest) = self.rows.as_chunks();
        let silent =
            |&[a, b, c, d]: &[RowSighting; 4]| a.known() | b.known() | c.known() | d.known() == 0;
        fours.iter().all(silent) && rest.iter().all(|row| row.known() == 0)
    }

    /// A copy of the piece, stored in `memory`, without the observations of these cells of its
    /// tile.
    pub(super) fn without<'r>(
        self,
        cells: &[u32; TILE_SIDE],
        memory: &'r mut [RowSighting; 2 * TILE_SIDE],
    ) -> Piece<'r> {
        let (id, first_row) = (self.id, self.first_row);
        let (rows, east) = memory.split_at_mut(TILE_SIDE);
        let mut len = 0;
        let left = self.fill().zip(cells.iter().skip(first_row));
        for (row, (sighting, cells)) in rows.iter_mut().zip(left) {
            let free = sighting.free & !cells;
            // Marks where the interior begins and ends, the form that the running XOR expects.
            *row = RowSighting { free: free ^ free << 1, hit: sighting.hit & !cells };
            len += 1;
        }
        Piece { id, first_row, rows: rows.get_mut(..len).unwrap_or_default(), east }
    }

    /// The hits in some of the rows.
    pub(super) fn hits(&self, rows: Range<usize>) -> impl Iterator<Item = u32> {
        self.rows.get(rows).unwrap_or_default().iter().map(|row| row.hit)
    }

    /// Reads and clears the observations of the rows: turns the flipped cells into the interior,
    /// and subtracts the hits from it.
    #[inline(always)]
    pub(super) fn fill(self) -> impl Iterator<Item = RowSighting> + use<'w> {
        self.rows.iter_mut().zip(self.east).map(|(row, east)| {
            let RowSighting { mut free, hit } = *row;
            if free | hit != 0 {
                *row = RowSighting::default();
                free ^= free << 1;
                free ^= free << 2;
                free ^= free << 4;
                free ^= free << 8;
                free ^= free << 16;
                east.free ^= free >> (TILE_SIDE - 1);
            }
            RowSighting { free: free & !hit, hit }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sense::{SensorModel, fill_beams};
    use proptest::prelude::*;
    use std::vec;
    use ubimap_protocol::units::{Angle, Millimetres, Pose};

    const RANGE: u16 = 4_000;
    const SIDE: Millimetres = Millimetres(50);

    proptest! {
        /// Sensors with narrow or full views, some of whose beams are removed at either end and in
        /// the middle.
        #[test]
        fn a_window_contains_everything_that_its_beams_reach(
            count in 2usize..400, angle in 0.1..6.2f32, is_pinhole: bool,
            heading: u16, x in -9_000i32..9_000, y in -9_000i32..9_000,
            holes in [0.0..0.3f32, 0.3..0.7, 0.9..1.0], missing in 0.0..0.2f32,
        ) {
            let mut beams = vec![Beam::NONE; count];
            let middle = (count - 1) as f32 / 2.0;
            let model = if is_pinhole {
                SensorModel::Pinhole { focal: 0.6 * count as f32, centre: middle }
            } else {
                SensorModel::Radial { first: -angle / 2.0, step: angle / count as f32 }
            };
            fill_beams(&mut beams, model, Pose::default());
            for hole in holes {
                let (from, to) = (hole * count as f32, (hole + missing) * count as f32);
                beams.iter_mut().take(to as usize).skip(from as usize).for_each(|beam| *beam = Beam::NONE);
            }
            let pose = Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle(heading) };
            let projection = Projection::new(pose, Pose::default(), SIDE);
            let mut memory = vec![RowSighting::default(); 2_000];
            let window = ScanWindow::over(&beams, RANGE, &projection, &mut memory).unwrap();
            let projection = projection.within(window.corner());
            let columns = (window.width * TILE_SIDE) as i32;
            for &beam in beams.iter().filter(|beam| **beam != Beam::NONE) {
                let (x, y) = projection.point(projection.direction(beam), beam.reading_at(RANGE));
                let (column, row) = (x >> FRACTION, y >> FRACTION);
                prop_assert!((1..columns - 1).contains(&column), "column {column} of {columns}");
                prop_assert!((1..window.rows as i32 - 1).contains(&row), "row {row} of {}", window.rows);
            }
        }
    }
}
