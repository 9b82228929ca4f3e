//! What one scan says of the cells around the robot.
//!
//! Free space is not carved ray by ray. The ends of the beams, in order of bearing, close a
//! polygon with the sensor; the cells inside, minus the hits, are free. Each edge of the polygon
//! flips one cell in every row of cells that it crosses; the running XOR along a row then is its
//! interior. Invalid beams break the polygon, and where the range jumps between two beams only
//! the nearer range is claimed between them: nothing is free that no beam crossed.

use ubimap_protocol::{
    tile::{TILE_SIDE, TileId},
    units::{Millimetres, Pose},
};

use super::evidence::RowSighting;
use crate::sense::{Beam, DIRECTION_BITS};

/// Fractional bits of a position in cells.
const FRACTION: i32 = 8;
const CELL: i32 = 1 << FRACTION;
/// Two beams whose readings differ by more than this look past an edge.
const JUMP: u16 = 150;

/// The longest range that can be mapped, in cells.
pub const MAX_RADIUS: usize = 1000;

/// Tiles along one side of the square around the sensor that a scan can touch.
const fn tiles_across(max_range: u16, resolution: Millimetres) -> usize {
    let resolution = if resolution.0 > 0 { resolution.0 as usize } else { 1 };
    let radius = (max_range as usize).div_ceil(resolution) + 1;
    (2 * radius + 1).div_ceil(TILE_SIDE) + 1
}

/// Words of scratch memory that scans of this range need: 4,704 (18.8 kB) for 4 m of 5 cm.
pub const fn scratch_words(max_range: u16, resolution: Millimetres) -> usize {
    let side = tiles_across(max_range, resolution);
    3 * side * side * TILE_SIDE
}

/// What is constant from scan to scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SightingConfig {
    /// The side of a cell.
    pub resolution: Millimetres,
    /// Beyond it nothing is mapped: millimetres, radial.
    pub max_range: u16,
    /// The sensor in `base_link`.
    pub mounting: Pose,
}

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

/// The cells that one scan says something of, in the caller's scratch memory.
#[derive(Debug)]
pub struct Sighting<'s> {
    /// The tile in the south-west corner, and tiles along a side.
    corner: TileId,
    side: usize,
    free: &'s mut [u32],
    hit: &'s mut [u32],
    near: &'s mut [u32],
}

type Point = (i32, i32);

impl<'s> Sighting<'s> {
    /// Works out what a scan taken at `pose` (`base_link` in `map`) says. `omit` tells whether
    /// a hit in this cell would say nothing new. `None` if `scratch` is shorter than
    /// [`scratch_words`] or the map does not reach this far.
    pub fn of_scan(
        config: &SightingConfig,
        beams: &[Beam],
        readings: &[u16],
        pose: Pose,
        scratch: &'s mut [u32],
        mut omit: impl FnMut(i32, i32) -> bool,
    ) -> Option<(Self, PixelCounts)> {
        let projection = Projection::new(config, pose);
        let side = tiles_across(config.max_range, config.resolution);
        let plane = side * side * TILE_SIDE;
        let (free, rest) = scratch.split_at_mut_checked(plane)?;
        let (hit, rest) = rest.split_at_mut_checked(plane)?;
        let near = rest.get_mut(..plane)?;
        free.fill(0);
        hit.fill(0);
        near.fill(0);
        let radius = (i32::from(config.max_range) / config.resolution.0.max(1)) + 2;
        let (cell_x, cell_y) = projection.cell;
        let corner = TileId::of_cell(cell_x.checked_sub(radius)?, cell_y.checked_sub(radius)?)?;
        // The far corner must be on the map as well.
        TileId::of_cell(cell_x.checked_add(radius + 64)?, cell_y.checked_add(radius + 64)?)?;
        let mut sighting = Self { corner, side, free, hit, near };
        let counts = sighting.draw(&projection.within(corner), config, beams, readings, &mut omit);
        sighting.fill();
        Some((sighting, counts))
    }

    fn draw(
        &mut self,
        projection: &Projection,
        config: &SightingConfig,
        beams: &[Beam],
        readings: &[u16],
        omit: &mut impl FnMut(i32, i32) -> bool,
    ) -> PixelCounts {
        let mut counts = PixelCounts::default();
        let (first_x, first_y) = self.corner.first_cell();
        // The free space ends half a cell before a hit: its cell, and its neighbours on a wall
        // that is seen at a slant, are not free.
        let margin = (config.resolution.0 / 2).clamp(0, 1000) as u16;
        let sensor = projection.origin;
        let mut last: Option<(Beam, u16, Point)> = None;
        for (&beam, &reading) in beams.iter().zip(readings) {
            counts.seen += 1;
            if reading == 0 || beam.limit == 0 {
                counts.invalid += 1;
                if let Some((.., end)) = last.take() {
                    self.edge(end, sensor);
                }
                continue;
            }
            let mut reach = beam.limit;
            if reading <= beam.limit {
                let (x, y) = projection.point(beam, reading);
                let (x, y) = (x >> FRACTION, y >> FRACTION);
                if omit(first_x + x, first_y + y) {
                    counts.omitted += 1;
                } else {
                    counts.kept += 1;
                }
                // The nearest quarter of the range, where the beams are closer than cells.
                self.mark(x, y, reading <= beam.limit / 4);
                reach = reading.saturating_sub(margin);
            } else {
                counts.kept += 1;
            }
            let end = projection.point(beam, reach);
            match last {
                None => self.edge(sensor, end),
                Some((_, before, from)) if before.abs_diff(reach) <= JUMP => self.edge(from, end),
                Some((_, before, from)) if before < reach => {
                    let step = projection.point(beam, before);
                    self.edge(from, step);
                    self.edge(step, end);
                }
                Some((earlier, _, from)) => {
                    let step = projection.point(earlier, reach);
                    self.edge(from, step);
                    self.edge(step, end);
                }
            }
            last = Some((beam, reach, end));
        }
        if let Some((.., end)) = last {
            self.edge(end, sensor);
        }
        counts
    }

    /// Marks a hit.
    fn mark(&mut self, x: i32, y: i32, near: bool) {
        let (Ok(x), Ok(y)) = (usize::try_from(x), usize::try_from(y)) else { return };
        if x >= self.side * TILE_SIDE {
            return;
        }
        let index = y * self.side + x / TILE_SIDE;
        let bit = 1 << (x % TILE_SIDE);
        if let Some(word) = self.hit.get_mut(index) {
            *word |= bit;
        }
        if near && let Some(word) = self.near.get_mut(index) {
            *word |= bit;
        }
    }

    /// Flips, in every row whose middle the edge crosses, the first cell whose middle is not to
    /// the west of the crossing.
    fn edge(&mut self, a: Point, b: Point) {
        let (low, high) = if a.1 <= b.1 { (a, b) } else { (b, a) };
        let row_of = |y: i32| (y + CELL / 2 - 1) >> FRACTION;
        let (first, last) = (row_of(low.1).max(0), row_of(high.1));
        if first >= last {
            return;
        }
        const SLOPE: u32 = 12;
        let slope = ((high.0 - low.0) << SLOPE) / (high.1 - low.1).max(1);
        let columns = (self.side * TILE_SIDE) as i32;
        for row in first..last {
            let up = (row << FRACTION) + CELL / 2 - low.1;
            let x = low.0 + ((i64::from(up) * i64::from(slope)) >> SLOPE) as i32;
            let column = row_of(x).max(0);
            if column < columns {
                let (row, column) = (row as usize, column as usize);
                if let Some(word) = self.free.get_mut(row * self.side + column / TILE_SIDE) {
                    *word ^= 1 << (column % TILE_SIDE);
                }
            }
        }
    }

    /// Turns flipped cells into the interior, less the hits.
    fn fill(&mut self) {
        let side = self.side.max(1);
        for (free, hit) in self.free.chunks_exact_mut(side).zip(self.hit.chunks_exact(side)) {
            let mut inside = 0;
            for (word, hit) in free.iter_mut().zip(hit) {
                let mut run = *word;
                for shift in [1, 2, 4, 8, 16] {
                    run ^= run << shift;
                }
                run ^= inside;
                inside = ((run as i32) >> 31) as u32;
                *word = run & !hit;
            }
        }
    }

    /// The tiles that the scan says something of, in order of their ids.
    pub fn tiles(&self) -> impl Iterator<Item = TileId> + '_ {
        let places = (0..self.side).flat_map(|column| (0..self.side).map(move |row| (column, row)));
        places.filter_map(|(column, row)| {
            let any = (0..TILE_SIDE).any(|y| {
                let sighting = self.row(column, row, y);
                sighting.free | sighting.hit != 0
            });
            any.then_some(TileId {
                x: self.corner.x + column as i16,
                y: self.corner.y + row as i16,
            })
        })
    }

    /// What the scan says of row `y` of a tile.
    pub fn tile_row(&self, id: TileId, y: usize) -> RowSighting {
        let offset = |id: i16, corner: i16| usize::try_from(i32::from(id) - i32::from(corner));
        match (offset(id.x, self.corner.x), offset(id.y, self.corner.y)) {
            (Ok(column), Ok(row)) if column < self.side && row < self.side => {
                self.row(column, row, y)
            }
            _ => RowSighting::default(),
        }
    }

    fn row(&self, column: usize, row: usize, y: usize) -> RowSighting {
        let index = (row * TILE_SIDE + y) * self.side + column;
        let word = |plane: &[u32]| plane.get(index).copied().unwrap_or(0);
        RowSighting { free: word(self.free), hit: word(self.hit), near: word(self.near) }
    }
}

/// From a beam and a reading to a position in 1/256 cells.
struct Projection {
    /// The cell that the sensor is in.
    cell: (i32, i32),
    /// The sensor.
    origin: Point,
    /// Cosine and sine of the heading, in 1/16,384.
    turn: (i32, i32),
    /// 1/256 cells in a millimetre, in 1/65,536.
    scale: i64,
}

impl Projection {
    fn new(config: &SightingConfig, pose: Pose) -> Self {
        let heading = pose.heading.radians() as f32;
        let one = (1 << DIRECTION_BITS) as f32;
        let (cos, sin) = (
            libm::roundf(libm::cosf(heading) * one) as i32,
            libm::roundf(libm::sinf(heading) * one) as i32,
        );
        let resolution = i64::from(config.resolution.0.max(1));
        let (forward, left) = (i64::from(config.mounting.x.0), i64::from(config.mounting.y.0));
        let (cos_64, sin_64) = (i64::from(cos), i64::from(sin));
        let along = |base: i32, offset: i64| {
            // In 1/256 cells, from the origin of the map.
            ((i64::from(base) << DIRECTION_BITS) + offset) * i64::from(CELL)
                / (resolution << DIRECTION_BITS)
        };
        let x = along(pose.x.0, forward * cos_64 - left * sin_64);
        let y = along(pose.y.0, forward * sin_64 + left * cos_64);
        let cell = ((x >> FRACTION) as i32, (y >> FRACTION) as i32);
        Self {
            cell,
            origin: (x as i32 & (CELL - 1), y as i32 & (CELL - 1)),
            turn: (cos, sin),
            scale: (i64::from(CELL) << 16) / resolution,
        }
    }

    /// The same with positions counted from the corner of a tile.
    fn within(self, corner: TileId) -> Self {
        let (x, y) = corner.first_cell();
        let origin = (
            self.origin.0 + ((self.cell.0 - x) << FRACTION),
            self.origin.1 + ((self.cell.1 - y) << FRACTION),
        );
        Self { origin, ..self }
    }

    fn point(&self, beam: Beam, reading: u16) -> Point {
        let (cos, sin) = self.turn;
        let (forward, left) = (i32::from(beam.forward), i32::from(beam.left));
        let reading = i64::from(reading);
        let project = |direction: i32| {
            let direction = i64::from(direction >> DIRECTION_BITS);
            ((direction * reading * self.scale) >> (DIRECTION_BITS + 16)) as i32
        };
        (
            self.origin.0 + project(forward * cos - left * sin),
            self.origin.1 + project(forward * sin + left * cos),
        )
    }
}

#[cfg(test)]
mod tests {
    use std::{collections::BTreeMap, vec, vec::Vec};

    use super::*;
    use crate::sense::{SensorModel, fill_beams};
    use proptest::prelude::*;
    use ubimap_protocol::units::Angle;

    const CONFIG: SightingConfig = SightingConfig {
        resolution: Millimetres(50),
        max_range: 4_000,
        mounting: Pose { x: Millimetres(0), y: Millimetres(0), heading: Angle(0) },
    };

    struct Seen {
        free: BTreeMap<(i32, i32), ()>,
        hit: BTreeMap<(i32, i32), ()>,
        counts: PixelCounts,
    }

    fn see(beams: &[Beam], readings: &[u16], pose: Pose) -> Seen {
        let mut scratch = vec![0; scratch_words(4_000, CONFIG.resolution)];
        let (sighting, counts) =
            Sighting::of_scan(&CONFIG, beams, readings, pose, &mut scratch, |_, _| false).unwrap();
        let mut seen = Seen { free: BTreeMap::new(), hit: BTreeMap::new(), counts };
        for id in sighting.tiles() {
            let (x0, y0) = id.first_cell();
            for y in 0..TILE_SIDE {
                let row = sighting.tile_row(id, y);
                assert_eq!(row.free & row.hit, 0);
                for x in 0..TILE_SIDE {
                    let cell = (x0 + x as i32, y0 + y as i32);
                    if row.free >> x & 1 != 0 {
                        seen.free.insert(cell, ());
                    }
                    if row.hit >> x & 1 != 0 {
                        seen.hit.insert(cell, ());
                    }
                }
            }
        }
        seen
    }

    fn half_circle(beams: usize) -> Vec<Beam> {
        let mut table = vec![Beam::default(); beams];
        let step = core::f32::consts::PI / (beams - 1) as f32;
        let model = SensorModel::Radial { first: -core::f32::consts::FRAC_PI_2, step };
        fill_beams(&mut table, model, Pose::default(), 4_000);
        table
    }

    /// The cell that a point at some range along beam `index` of [`half_circle`] lies in.
    fn cell_at(pose: Pose, beams: usize, index: f64, range: f64) -> (i32, i32) {
        let bearing = -core::f64::consts::FRAC_PI_2
            + index * core::f64::consts::PI / (beams - 1) as f64
            + pose.heading.radians();
        let x = pose.x.metres() * 1000.0 + range * bearing.cos();
        let y = pose.y.metres() * 1000.0 + range * bearing.sin();
        ((x / 50.0).floor() as i32, (y / 50.0).floor() as i32)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]

        /// Cell by cell against the beams themselves: what is free was crossed, or lies between
        /// two neighbouring beams that both went further; what the middles of two such beams
        /// crossed is free.
        #[test]
        fn the_polygon_is_what_the_beams_crossed(
            ranges in proptest::collection::vec(prop_oneof![3 => 300u16..4_000, 1 => Just(0u16)], 4..24),
            x in -9_000i32..9_000, y in -9_000i32..9_000, heading: u16,
        ) {
            let pose = Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle(heading) };
            let beams = half_circle(181);
            // Walls of eight beams each.
            let readings: Vec<u16> = (0..181).map(|beam| ranges[beam / 8 % ranges.len()]).collect();
            let seen = see(&beams, &readings, pose);
            prop_assert_eq!(seen.counts.invalid as usize, readings.iter().filter(|&&r| r == 0).count());
            for (index, &reading) in readings.iter().enumerate() {
                if reading != 0 {
                    let cell = cell_at(pose, 181, index as f64, f64::from(reading));
                    let near = |cell: (i32, i32)| (-1..=1).any(|dx| (-1..=1).any(|dy|
                        seen.hit.contains_key(&(cell.0 + dx, cell.1 + dy))));
                    prop_assert!(near(cell), "no hit near {cell:?}");
                }
                let Some(&next) = readings.get(index + 1) else { continue };
                let reach = reading.min(next);
                if reach == 0 {
                    continue;
                }
                // Nearer, eight beams are narrower than a cell.
                let mut range = 700.0;
                while range < f64::from(reach) - 130.0 {
                    let cell = cell_at(pose, 181, index as f64 + 0.5, range);
                    let near = |cell: (i32, i32)| (-1..=1).any(|dx| (-1..=1).any(|dy|
                        seen.free.contains_key(&(cell.0 + dx, cell.1 + dy))));
                    prop_assert!(near(cell), "{cell:?} at {range} is not free");
                    range += 50.0;
                }
            }
            for &(cx, cy) in seen.free.keys() {
                let dx = f64::from(cx * 50 + 25 - x);
                let dy = f64::from(cy * 50 + 25 - y);
                let range = dx.hypot(dy);
                let bearing = (dy.atan2(dx) - pose.heading.radians()).rem_euclid(core::f64::consts::TAU);
                let index = (bearing + core::f64::consts::FRAC_PI_2)
                    .rem_euclid(core::f64::consts::TAU) / core::f64::consts::PI * 180.0;
                let index = if index > 270.0 { index - 360.0 } else { index };
                let (low, high) = ((index - 1.0).floor().max(0.0), (index + 1.0).ceil().min(180.0));
                let furthest = (low as i64..=high as i64).map(|i| readings[i.clamp(0, 180) as usize]).max();
                // Near the sensor one cell is many beams wide.
                prop_assert!(range < 150.0 || f64::from(furthest.unwrap_or(0)) + 40.0 >= range,
                    "free at {range} mm, beam {index}, but nothing seen beyond {furthest:?}");
            }
        }
    }

    #[test]
    fn a_scan_without_a_return_says_nothing() {
        let beams = half_circle(181);
        let seen = see(&beams, &[0; 181], Pose::default());
        assert!(seen.free.is_empty() && seen.hit.is_empty());
    }

    #[test]
    fn beyond_the_range_the_way_is_free_up_to_it() {
        let beams = half_circle(181);
        let seen = see(&beams, &[30_000; 181], Pose::default());
        assert!(seen.hit.is_empty());
        // Half a disc of 4 m.
        let expected = core::f64::consts::PI * 80.0 * 80.0 / 2.0;
        assert!((seen.free.len() as f64 - expected).abs() < 160.0, "{}", seen.free.len());
    }

    #[test]
    fn a_scan_at_the_end_of_the_map_is_refused() {
        let beams = half_circle(5);
        let mut scratch = vec![0; scratch_words(4_000, CONFIG.resolution)];
        for x in [i32::MAX, i32::MIN, 52_428_000] {
            let pose = Pose { x: Millimetres(x), ..Pose::default() };
            let seen =
                Sighting::of_scan(&CONFIG, &beams, &[900; 5], pose, &mut scratch, |_, _| false);
            assert!(seen.is_none(), "{x}");
        }
        let mut short = [0; 9];
        let pose = Pose::default();
        assert!(
            Sighting::of_scan(&CONFIG, &beams, &[900; 5], pose, &mut short, |_, _| false).is_none()
        );
    }
}
