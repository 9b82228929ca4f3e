//! From a beam and a reading to a position in the map's grid (Aluckal, "offsetting").

use ubimap_protocol::units::{Millimetres, Pose};

use crate::{
    sense::{Beam, DIRECTION_BITS},
    trigonometry::{radians, round, sin_cos},
};

/// Fractional bits of a position in cells.
pub(super) const FRACTION: u32 = 16;
/// The minimum side of a map cell: below about 12 mm the fixed-point projection would overflow.
pub const MIN_RESOLUTION: Millimetres = Millimetres(20);

/// One cell.
pub(super) const CELL: i32 = 1 << FRACTION;

/// A position: x and y in 1/65,536 cells.
pub(super) type Point = (i32, i32);

/// A corner of the polygon of free space (see `trace`): x and y in 1/65,536 cells, relative to a
/// cell's centre, so that their integer parts are the first column and row whose centres are at or
/// beyond the corner.
pub(super) type Corner = (i32, i32);

/// Distance from the centre of a cell to its last point before the next cell, in 1/65,536 cells.
const TO_MIDDLE: i32 = CELL / 2 - 1;

/// Additional fractional bits of a [`Direction`].
const EXTRA: u32 = 3;

/// The direction of a beam: in 1/524,288 cells per millimetre of reading, along x and y of the map.
#[derive(Clone, Copy, Default)]
pub(super) struct Direction(pub(super) i32, pub(super) i32);

/// Converts readings to positions on the grid, for one position and heading of the sensor.
#[derive(Clone, Copy, Debug)]
pub(super) struct Projection {
    /// The cell that contains the sensor.
    cell: (i32, i32),
    /// The sensor's position, relative to the corner of the current grid.
    origin: Point,
    /// Cosine and sine of the heading, in 1/524,288 cells per millimetre.
    turn: (i32, i32),
    /// One millimetre, in 1/524,288 cells.
    millimetre: i32,
}

impl Projection {
    /// The projection for a robot at `pose` (`base_link` in `map`), with a sensor at `mounting` in
    /// `base_link` and cells of at least [`MIN_RESOLUTION`]. The heading of `mounting` is ignored:
    /// the table of beams includes it. Positions are relative to the corner of the sensor's cell.
    pub(super) fn new(pose: Pose, mounting: Pose, resolution: Millimetres) -> Self {
        let one = (1 << DIRECTION_BITS) as f32;
        let (sin, cos) = sin_cos(radians(pose.heading));
        let (sin, cos) = (round(sin * one) as i32, round(cos * one) as i32);
        let side = resolution.max(MIN_RESOLUTION).0;
        let (forward, left) = (i64::from(mounting.x.0), i64::from(mounting.y.0));
        let (cos_64, sin_64) = (i64::from(cos), i64::from(sin));
        let half = 1 << (DIRECTION_BITS - 1);
        let along = |base: Millimetres, offset: i64| {
            base.0.wrapping_add(((offset + half) >> DIRECTION_BITS) as i32)
        };
        let x = along(pose.x, forward * cos_64 - left * sin_64);
        let y = along(pose.y, forward * sin_64 + left * cos_64);
        let fraction = |position: i32| (position.rem_euclid(side) << FRACTION) / side;
        let scale = |turn: i32| (turn << (FRACTION + EXTRA - DIRECTION_BITS)) / side;
        Self {
            cell: (x.div_euclid(side), y.div_euclid(side)),
            origin: (fraction(x), fraction(y)),
            turn: (scale(cos), scale(sin)),
            millimetre: (CELL << EXTRA) / side,
        }
    }

    /// The cell of the grid that contains the sensor.
    pub(super) fn cell(&self) -> (i32, i32) {
        self.cell
    }

    /// The same projection with positions relative to another cell, at most 1,000 cells away.
    pub(super) fn within(self, (x, y): (i32, i32)) -> Self {
        let shifted = |origin: i32, cell: i32, corner: i32| {
            origin.wrapping_add(cell.wrapping_sub(corner) << FRACTION)
        };
        let origin =
            (shifted(self.origin.0, self.cell.0, x), shifted(self.origin.1, self.cell.1, y));
        Self { origin, ..self }
    }

    /// The sensor's position.
    pub(super) fn origin(&self) -> Point {
        self.origin
    }

    /// The sensor's position as a corner of the polygon of free space.
    #[inline(always)]
    pub(super) fn sensor(&self) -> Corner {
        (self.origin.0.wrapping_add(TO_MIDDLE), self.origin.1.wrapping_add(TO_MIDDLE))
    }

    /// Converts millimetres to 1/65,536 cells.
    pub(super) fn length(&self, millimetres: u16) -> i32 {
        self.millimetre.wrapping_mul(millimetres.into()) >> EXTRA
    }

    /// The direction of a beam.
    #[inline(always)]
    pub(super) fn direction(&self, beam: Beam) -> Direction {
        let (cos, sin) = self.turn;
        let (forward, left) = (i32::from(beam.forward), i32::from(beam.left));
        Direction(
            (forward * cos - left * sin) >> DIRECTION_BITS,
            (forward * sin + left * cos) >> DIRECTION_BITS,
        )
    }

    /// The end of a beam in this direction, for a reading that spans at most 1,000 cells.
    #[inline(always)]
    pub(super) fn point(&self, direction: Direction, reading: u32) -> Point {
        direction.from(self.origin, reading)
    }

    /// The end of a beam as a corner of the polygon of free space.
    #[inline(always)]
    pub(super) fn corner(&self, direction: Direction, reading: u32) -> Corner {
        direction.from(self.sensor(), reading)
    }
}

impl Direction {
    #[inline(always)]
    fn from(self, (x, y): Point, reading: u32) -> Point {
        let reading = reading as i32;
        (
            x.wrapping_add(self.0.wrapping_mul(reading) >> EXTRA),
            y.wrapping_add(self.1.wrapping_mul(reading) >> EXTRA),
        )
    }
}
