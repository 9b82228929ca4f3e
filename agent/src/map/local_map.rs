//! The robot's own layer of the map: its observations, in a fixed pool of tiles.

use core::ops::Range;

use ubimap_protocol::{
    tile::{TILE_SIDE, Tile, TileId},
    time::Instant,
    units::{Millimetres, Pose},
};

use super::{
    evidence::RowSighting,
    own_tile::{OwnTile, Pool},
    policy::Policy,
    projection::Projection,
    scan_window::{Piece, ScanWindow, below, words_of},
    trace::{Grain, Part, PixelCounts, trace},
};
use crate::{
    sense::{Beam, Validity},
    timing::AGEING_INTERVAL,
};

/// Maximum mapped range, in cells.
pub const MAX_RADIUS: usize = 1000;

/// Number of scratch words for scans of `max_range` millimetres: 340 (2.7 kB) for 4 m with cells of
/// 5 cm.
pub const fn scratch_words(max_range: u16, resolution: Millimetres) -> usize {
    let side = if resolution.0 > 0 { resolution.0 as usize } else { 1 };
    words_of((max_range as usize).div_ceil(side))
}

/// Parameters that are constant from scan to scan.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MappingConfig {
    /// The side of a cell.
    pub resolution: Millimetres,
    /// Maximum radial range that is mapped, in millimetres.
    pub max_range: u16,
    /// Hits count twice as evidence if their distances from the sensor along `map`'s x and y are
    /// both at most this, in millimetres.
    pub near: u16,
    /// The sensor in `base_link`.
    pub mounting: Pose,
    /// Which readings are valid.
    pub validity: Validity,
    /// Which part of a scan is mapped.
    pub policy: Policy,
}

/// The cells in which hits are near: a square around the sensor.
struct Near {
    low: (i32, i32),
    high: (i32, i32),
}

impl Near {
    fn new(projection: &Projection, near: u16, resolution: Millimetres) -> Self {
        let radius = i32::from(near) / resolution.0.max(1);
        let (x, y) = projection.cell();
        Self {
            low: (x.wrapping_sub(radius), y.wrapping_sub(radius)),
            high: (x.wrapping_add(radius + 1), y.wrapping_add(radius + 1)),
        }
    }

    /// The part of the square that lies in a tile.
    fn within(&self, id: TileId) -> NearCells {
        let (x, y) = id.first_cell();
        let side = TILE_SIDE as i32;
        let from = |low: i32, first: i32| low.wrapping_sub(first).max(0).min(side) as u32;
        let rows = from(self.low.1, y) as usize..from(self.high.1, y) as usize;
        NearCells { rows, columns: below(from(self.high.0, x)) & !below(from(self.low.0, x)) }
    }
}

/// The cells of one tile in which hits are near.
struct NearCells {
    /// The rows of these cells.
    rows: Range<usize>,
    /// The columns of these cells, the same in every row.
    columns: u32,
}

/// The result of mapping a scan.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mapped {
    /// Counts of the scan's readings.
    pub pixels: PixelCounts,
    /// Cells dropped because the tile pool was full.
    pub cells_refused: u32,
}

/// What must be known about one tile to map a scan into it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Surround<'m> {
    /// The server's map, if held.
    pub merged: Option<&'m Tile>,
    /// The cells covered by cameras, which the robot does not map, a word per row; `None` if there
    /// are none.
    pub covered: Option<&'m [u32; TILE_SIDE]>,
    /// The cells occupied by other robots, a word per row; `None` if there are none.
    pub masked: Option<[u32; TILE_SIDE]>,
}

impl<'m> Surround<'m> {
    /// The cells that are not mapped, a word per row; `None` if there are none.
    #[inline(always)]
    fn left_out(&mut self) -> Option<&[u32; TILE_SIDE]> {
        let Some(masked) = &mut self.masked else { return self.covered };
        let covered = self.covered.into_iter().flatten();
        masked.iter_mut().zip(covered).for_each(|(row, covered)| *row |= covered);
        Some(masked)
    }
}

/// The map of one robot.
#[derive(Debug)]
pub struct LocalMap<'b> {
    resolution: Millimetres,
    near: u16,
    mounting: Pose,
    policy: Policy,
    grain: Grain,
    /// Distance up to which the ground is free where the sensor has nothing in range, in millimetres.
    clear: u16,
    /// Holds no observation between calls.
    scratch: &'b mut [RowSighting],
    /// The tiles.
    pub pool: Pool<'b>,
    scans: u32,
    /// When the evidence ages next.
    next_ageing: Instant,
}

impl<'b> LocalMap<'b> {
    /// An empty map for one sensor. `scratch` must have at least [`scratch_words`] words.
    pub fn new(
        config: MappingConfig,
        beams: &[Beam],
        scratch: &'b mut [RowSighting],
        pool: Pool<'b>,
    ) -> Self {
        scratch.fill(RowSighting::default());
        let MappingConfig { resolution, near, mounting, policy, .. } = config;
        let (grain, clear) = (grain(&config, beams), config.validity.clear);
        Self {
            resolution,
            near,
            mounting,
            policy,
            grain,
            clear,
            scratch,
            pool,
            scans: 0,
            next_ageing: Instant(0),
        }
    }

    /// Changes the sensor's mounting or validity; `beams` is the new table.
    pub(crate) fn configure(&mut self, config: MappingConfig, beams: &[Beam]) {
        let MappingConfig { resolution, near, mounting, policy, .. } = config;
        (self.resolution, self.near) = (resolution, near);
        (self.mounting, self.policy) = (mounting, policy);
        (self.grain, self.clear) = (grain(&config, beams), config.validity.clear);
    }

    /// The latest time for the next call of [`LocalMap::timeout`].
    pub fn poll_timeout(&self) -> Instant {
        self.next_ageing
    }

    /// Ages the evidence if that is due: evidence against the server's map that was too weak to be
    /// sent is reset. `merged` returns the server's map of a tile, if held.
    pub fn timeout<'m>(&mut self, now: Instant, merged: impl Fn(TileId) -> Option<&'m Tile>) {
        if now < self.next_ageing {
            return;
        }
        self.next_ageing = now + AGEING_INTERVAL;
        for tile in self.pool.tiles_mut() {
            if let Some(known) = tile.id.and_then(&merged) {
                tile.evidence.settle(known, tile.publication.sent());
            }
        }
    }

    /// Adds a scan taken at a pose (`base_link` in `map`), up to `range` millimetres. `around`
    /// returns what is known about a tile. `None` if part of the scan is outside the map's
    /// coordinates.
    #[inline(never)]
    pub fn add<'m>(
        &mut self,
        beams: &[Beam],
        readings: &[u16],
        (pose, range): (Pose, u16),
        around: impl Fn(TileId) -> Surround<'m>,
    ) -> Option<Mapped> {
        let Self { resolution, near, mounting, policy, .. } = *self;
        self.scans = self.scans.wrapping_add(1);
        let shorter = self.grain.within(range);
        let grain = shorter.as_ref().unwrap_or(&self.grain);
        let projection = Projection::new(pose, mounting, resolution);
        let mut mapped = Mapped::default();
        // Whether any hit was new.
        let mut news = false;
        let count = beams.len().min(readings.len());
        // What no echo says counts in every second scan only, from the first one on.
        let grain = &grain.clear_to(if self.scans % 2 == 1 { self.clear } else { 0 });
        // The whole scan at once, or in parts that fit the scratch memory.
        let (mut start, mut end) = (0, count);
        while start < count {
            let part = beams.get(start..end)?;
            let Some(mut window) = ScanWindow::over(part, grain.range(), &projection, self.scratch)
            else {
                if end - start <= 2 {
                    return None;
                }
                end = start + (end - start).div_ceil(2);
                continue;
            };
            if !window.is_on_the_map() {
                return None;
            }
            let readings = readings.get(start..end)?;
            let part = Part { beams: part, readings, is_continued: start > 0 };
            let projection = projection.within(window.corner());
            let nearest = trace(&mut window, &projection, grain, part, &mut mapped.pixels);
            // The corners of the square of near cells are at most this far from the sensor.
            let near_cells = (nearest <= u32::from(near) * 91 / 64)
                .then(|| Near::new(&projection, near, resolution));
            let Self { pool, scans, .. } = self;
            window.for_each_piece(|piece| {
                let surround = around(piece.id);
                match weigh(pool, *scans, piece, surround, near_cells.as_ref()) {
                    Ok(is_news) => news |= is_news,
                    Err(Refused(cells)) => mapped.cells_refused += cells,
                }
            });
            if end == count {
                break;
            }
            // The next part starts with the last beam of this one, so that the space between the
            // two is drawn.
            (start, end) = (end - 1, count);
        }
        if policy == Policy::Full && !news {
            mapped.pixels.omitted += core::mem::take(&mut mapped.pixels.kept);
        }
        Some(mapped)
    }
}

/// Number of cells of a piece that were dropped because the pool was full.
struct Refused(u32);

/// Adds a piece of scan `scan` to its tile's evidence. Returns whether there were new hits.
#[inline(always)]
fn weigh(
    pool: &mut Pool<'_>,
    scan: u32,
    piece: Piece<'_>,
    mut surround: Surround<'_>,
    near: Option<&Near>,
) -> Result<bool, Refused> {
    let merged = surround.merged;
    let mut memory;
    let piece = match surround.left_out() {
        None => piece,
        Some(left_out) => {
            memory = [RowSighting::default(); 2 * TILE_SIDE];
            piece.without(left_out, &mut memory)
        }
    };
    if piece.says_nothing() {
        return Ok(false);
    }
    let Some(tile) = pool.find_or_begin(piece.id, scan) else {
        return Err(Refused(piece.fill().map(|row| row.known().count_ones()).sum()));
    };
    tile.dirty = true;
    if let Some(near) = near {
        weigh_near(tile, &piece, &near.within(piece.id), merged);
    }
    Ok(count(tile, piece, merged))
}

/// Counts the near hits of a piece once more than `count` does. Must be called before it.
#[inline(always)]
fn weigh_near(tile: &mut OwnTile, piece: &Piece<'_>, near: &NearCells, merged: Option<&Tile>) {
    let first = piece.first_row;
    let end = near.rows.end.min(first + piece.len());
    let rows = near.rows.start.max(first)..end;
    let hits = piece.hits(rows.start.wrapping_sub(first)..end.wrapping_sub(first));
    tile.evidence.add_near(rows.start, hits.map(|hit| hit & near.columns), merged);
}

/// Adds the observations of a piece to the evidence. Not inlined, so that the loop over its rows
/// has all registers.
#[inline(never)]
fn count(tile: &mut OwnTile, piece: Piece<'_>, merged: Option<&Tile>) -> bool {
    let first = piece.first_row;
    match merged {
        None => tile.evidence.add(first, piece.fill()),
        Some(merged) => tile.evidence.add_beside(first, piece.fill(), merged),
    }
}

fn grain(config: &MappingConfig, beams: &[Beam]) -> Grain {
    Grain::new(beams, config.resolution, config.max_range, config.validity, config.policy)
}

#[cfg(test)]
mod tests {
    use std::{collections::BTreeSet, vec, vec::Vec};

    use super::*;
    use crate::{
        map::OwnTile,
        sense::{NOTHING_IN_RANGE, SensorModel, fill_beams},
    };
    use proptest::prelude::*;
    use ubimap_protocol::{tile::Cell, units::Angle};

    const CONFIG: MappingConfig = MappingConfig {
        resolution: Millimetres(50),
        max_range: 4_000,
        near: 703,
        mounting: Pose { x: Millimetres(0), y: Millimetres(0), heading: Angle(0) },
        validity: Validity { nearest: 1, farthest: u16::MAX, removed: (0, 0), flying: 0, clear: 0 },
        policy: Policy::Full,
    };

    struct Seen {
        free: BTreeSet<(i32, i32)>,
        hit: BTreeSet<(i32, i32)>,
        counts: PixelCounts,
    }

    /// The result of a first scan on an empty map, with `words` words of scratch memory, which
    /// determine the number of parts in which the scan is drawn.
    fn see_with(words: usize, beams: &[Beam], readings: &[u16], pose: Pose) -> Seen {
        see_all(CONFIG, words, beams, &[readings], pose)
    }

    /// The result of several scans from one pose; the counts are those of the last.
    fn see_all(
        config: MappingConfig,
        words: usize,
        beams: &[Beam],
        scans: &[&[u16]],
        pose: Pose,
    ) -> Seen {
        let mut scratch = vec![RowSighting::default(); words];
        let mut places = vec![OwnTile::FREE; 40];
        let mut map = LocalMap::new(config, beams, &mut scratch, Pool::new(&mut places));
        let mut counts = PixelCounts::default();
        for readings in scans {
            let mapped = map.add(beams, readings, (pose, u16::MAX), |_| Surround::default());
            let mapped = mapped.unwrap();
            assert_eq!(mapped.cells_refused, 0);
            counts = mapped.pixels;
        }
        let mut seen = Seen { free: BTreeSet::new(), hit: BTreeSet::new(), counts };
        for tile in map.pool.tiles() {
            let (x0, y0) = tile.id().unwrap().first_cell();
            let cells = tile.evidence.cells();
            for (x, y) in (0..TILE_SIDE).flat_map(|y| (0..TILE_SIDE).map(move |x| (x, y))) {
                let cell = (x0 + x as i32, y0 + y as i32);
                match cells.cell(x, y) {
                    Cell::Free => seen.free.insert(cell),
                    Cell::Unknown => continue,
                    _ => seen.hit.insert(cell),
                };
            }
        }
        assert!(scratch.iter().all(|row| row.known() == 0), "the scratch memory is not clean");
        seen
    }

    fn see(beams: &[Beam], readings: &[u16], pose: Pose) -> Seen {
        see_with(scratch_words(4_000, CONFIG.resolution), beams, readings, pose)
    }

    fn half_circle(beams: usize) -> Vec<Beam> {
        let mut table = vec![Beam::default(); beams];
        let step = core::f32::consts::PI / (beams - 1) as f32;
        let model = SensorModel::Radial { first: -core::f32::consts::FRAC_PI_2, step };
        fill_beams(&mut table, model, Pose::default());
        table
    }

    /// The cell of a point at some range along beam `index` of [`half_circle`].
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

        /// Compares each cell with the beams. A free cell was crossed by a beam, or lies between
        /// two adjacent beams that both reached farther; a cell on the centre line between two such
        /// beams is free.
        #[test]
        fn the_polygon_covers_the_cells_that_beams_crossed(
            ranges in proptest::collection::vec(prop_oneof![3 => 300u16..4_000, 1 => Just(0u16)], 4..24),
            x in -9_000i32..9_000, y in -9_000i32..9_000, heading: u16,
        ) {
            let pose = Pose { x: Millimetres(x), y: Millimetres(y), heading: Angle(heading) };
            let beams = half_circle(181);
            // Walls eight beams wide.
            let readings: Vec<u16> = (0..181).map(|beam| ranges[beam / 8 % ranges.len()]).collect();
            let seen = see(&beams, &readings, pose);
            prop_assert_eq!(seen.counts.invalid as usize, readings.iter().filter(|&&r| r == 0).count());
            for (index, &reading) in readings.iter().enumerate() {
                if reading != 0 {
                    let cell = cell_at(pose, 181, index as f64, f64::from(reading));
                    let near = |cell: (i32, i32)| (-1..=1).any(|dx| (-1..=1).any(|dy|
                        seen.hit.contains(&(cell.0 + dx, cell.1 + dy))));
                    prop_assert!(near(cell), "no hit near {cell:?}");
                }
                let Some(&next) = readings.get(index + 1) else { continue };
                let reach = reading.min(next);
                if reach == 0 {
                    continue;
                }
                // At shorter range eight beams are narrower than a cell.
                let mut range = 700.0;
                while range < f64::from(reach) - 130.0 {
                    let cell = cell_at(pose, 181, index as f64 + 0.5, range);
                    let near = |cell: (i32, i32)| (-1..=1).any(|dx| (-1..=1).any(|dy|
                        seen.free.contains(&(cell.0 + dx, cell.1 + dy))));
                    prop_assert!(near(cell), "{cell:?} at {range} is not free");
                    range += 50.0;
                }
            }
            for &(cx, cy) in &seen.free {
                let dx = f64::from(cx * 50 + 25 - x);
                let dy = f64::from(cy * 50 + 25 - y);
                let range = dx.hypot(dy);
                let bearing = (dy.atan2(dx) - pose.heading.radians()).rem_euclid(core::f64::consts::TAU);
                let index = (bearing + core::f64::consts::FRAC_PI_2)
                    .rem_euclid(core::f64::consts::TAU) / core::f64::consts::PI * 180.0;
                let index = if index > 270.0 { index - 360.0 } else { index };
                let (low, high) = ((index - 1.0).floor().max(0.0), (index + 1.0).ceil().min(180.0));
                let furthest = (low as i64..=high as i64).map(|i| readings[i.clamp(0, 180) as usize]).max();
                // Near the sensor a cell covers many beams.
                prop_assert!(range < 150.0 || f64::from(furthest.unwrap_or(0)) + 40.0 >= range,
                    "free at {range} mm, beam {index}, but nothing seen beyond {furthest:?}");
            }
        }
    }

    #[test]
    fn a_scan_without_returns_changes_nothing() {
        let beams = half_circle(181);
        let seen = see(&beams, &[0; 181], Pose::default());
        assert!(seen.free.is_empty() && seen.hit.is_empty());
    }

    #[test]
    fn returns_beyond_the_range_free_the_space_up_to_it() {
        let beams = half_circle(181);
        let seen = see(&beams, &[30_000; 181], Pose::default());
        assert!(seen.hit.is_empty());
        // Half a disc with a radius of 4 m.
        let expected = core::f64::consts::PI * 80.0 * 80.0 / 2.0;
        assert!((seen.free.len() as f64 - expected).abs() < 160.0, "{}", seen.free.len());
    }

    #[test]
    fn a_wall_that_leaves_the_range_is_drawn_up_to_its_limit() {
        let mut beams = [Beam::default(); 640];
        let camera = SensorModel::Pinhole { focal: 343.1, centre: 319.5 };
        fill_beams(&mut beams, camera, Pose::default());
        let seen = see(&beams, &[3_820; 640], Pose::default());
        assert!(seen.hit.iter().all(|&(x, _)| x == 76));
        // At 1,186 mm to the side it is 4 m away.
        let ends = seen.hit.first().zip(seen.hit.last());
        assert_eq!(ends, Some((&(76, -24), &(76, 23))));
        assert!(seen.hit.len() > 44, "{:?}", seen.hit);
    }

    #[test]
    fn a_wall_briefly_in_range_is_drawn() {
        // The wall must be drawn whichever beams are sampled.
        for shift in 0..70u8 {
            let mut beams = [Beam::default(); 640];
            let camera = SensorModel::Pinhole { focal: 343.1, centre: 319.5 + f32::from(shift) };
            fill_beams(&mut beams, camera, Pose::default());
            let hit = see(&beams, &[3_990; 640], Pose::default()).hit;
            // At 283 mm to the side it is 4 m away.
            assert!(hit.iter().all(|&(x, y)| x == 79 && (-6..6).contains(&y)), "{shift}: {hit:?}");
            assert!(hit.len() >= 10, "{shift}: {hit:?}");
        }
    }

    #[test]
    fn missing_returns_on_a_wall_beyond_the_range_draw_no_hits() {
        let beams = half_circle(721);
        for shift in 0..40 {
            // Every second beam has no return.
            let reading = |beam: u16| if beam % 2 == 1 { 0 } else { 3_200 + 2 * (beam + shift) };
            let readings: Vec<u16> = (0..721).map(reading).collect();
            let seen = see(&beams, &readings, Pose::default());
            let is_near = |&&(x, y): &&(i32, i32)| x * x + y * y < 60 * 60;
            assert_eq!(seen.hit.iter().find(is_near), None, "{shift}");
        }
    }

    fn see_clear(clear: u16, scans: &[&[u16]]) -> Seen {
        let validity = Validity { clear, ..CONFIG.validity };
        let (config, beams) = (MappingConfig { validity, ..CONFIG }, half_circle(181));
        let words = scratch_words(4_000, CONFIG.resolution);
        see_all(config, words, &beams, scans, Pose::default())
    }

    #[test]
    fn nothing_in_range_is_free_up_to_where_it_says_so() {
        let nothing = [NOTHING_IN_RANGE; 181];
        assert_eq!(see_clear(0, &[&nothing]).counts.invalid, 181);
        for clear in [1_000, 2_500, 4_000, u16::MAX] {
            let seen = see_clear(clear, &[&nothing]);
            let range = f64::from(clear.min(4_000)) / 1_000.0;
            let metres = |x: i32, y: i32| (f64::from(x) + 0.5).hypot(f64::from(y) + 0.5) * 0.05;
            for (x, y) in (1..90).flat_map(|x| (-90..90).map(move |y| (x, y))) {
                let (is_free, metres) = (seen.free.contains(&(x, y)), metres(x, y));
                assert!(is_free || metres > range - 0.1, "{clear}: {x}, {y}");
                assert!(!is_free || metres < range + 0.04, "{clear}: {x}, {y}");
            }
            assert!(seen.hit.is_empty());
        }
        // Beside surfaces, and readings beyond the range, neither is drawn where the other is.
        let mixed: Vec<u16> = (0..181)
            .map(|beam| match beam {
                0..60 => NOTHING_IN_RANGE,
                60..120 => 9_000,
                _ => 3_000,
            })
            .collect();
        let seen = see_clear(2_000, &[&mixed]);
        for &(x, y) in seen.free.union(&seen.hit) {
            let (x, y) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
            let (bearing, metres) = (y.atan2(x).to_degrees(), x.hypot(y) * 0.05);
            let most = match bearing {
                ..-31.0 => 2.0,
                ..31.0 => 4.0,
                _ => 3.1,
            };
            assert!(metres <= most + 0.04, "{bearing} {metres}");
        }
        assert!(seen.free.contains(&(70, 0)) && !seen.free.contains(&(30, -31)));
    }

    #[test]
    fn nothing_in_range_counts_half_as_much_as_a_reading() {
        let (wall, nothing) = ([2_000; 181], [NOTHING_IN_RANGE; 181]);
        let after = |others: usize, other: &[u16]| {
            let scans = [vec![&wall[..]], vec![other; others]].concat();
            let seen = see_clear(4_000, &scans);
            seen.hit.contains(&(40, 0)) || seen.hit.contains(&(39, 0))
        };
        // After how many scans a wall that was hit once is gone.
        let gone = |other: &[u16]| (1..20).find(|&count| !after(count, other)).unwrap();
        let beyond = gone(&[3_000; 181]);
        assert!((2 * beyond - 1..=2 * beyond).contains(&gone(&nothing)), "{beyond}");
    }

    #[test]
    fn gaps_narrower_than_a_cell_are_bridged() {
        let mut beams = [Beam::default(); 640];
        let camera = SensorModel::Pinhole { focal: 343.1, centre: 319.5 };
        fill_beams(&mut beams, camera, Pose::default());
        let whole = see(&beams, &[2_000; 640], Pose::default());
        // Adjacent columns are 5.8 mm apart.
        let with_gap = |from: usize, columns: usize| {
            let mut readings = [2_000; 640];
            readings[from..from + columns].fill(0);
            see(&beams, &readings, Pose::default())
        };
        for from in (1..600).step_by(37) {
            let (narrow, wide) = (with_gap(from, 6), with_gap(from, 30));
            assert_eq!((narrow.counts.invalid, wide.counts.invalid), (6, 30));
            assert!(narrow.free == whole.free, "{from}");
            assert!(wide.free.len() + 50 < whole.free.len(), "{from}");
        }
    }

    #[test]
    fn a_scan_beyond_the_maps_coordinates_is_refused() {
        let beams = half_circle(5);
        let add = |words: usize, pose: Pose| {
            let mut scratch = vec![RowSighting::default(); words];
            let mut places = vec![OwnTile::FREE; 40];
            let mut map = LocalMap::new(CONFIG, &beams, &mut scratch, Pool::new(&mut places));
            map.add(&beams, &[900; 5], (pose, u16::MAX), |_| Surround::default())
        };
        let words = scratch_words(4_000, CONFIG.resolution);
        for x in [i32::MAX, i32::MIN, 52_428_000] {
            let pose = Pose { x: Millimetres(x), ..Pose::default() };
            assert_eq!(add(words, pose), None, "{x}");
        }
        assert_eq!(add(9, Pose::default()), None);
    }

    #[test]
    fn a_scan_drawn_in_parts_gives_the_same_map() {
        let beams = half_circle(181);
        let readings: Vec<u16> = (0..181).map(|beam| 1_500 + beam * 7 % 900).collect();
        for heading in [0, 7_000, 30_000] {
            let pose = Pose { heading: Angle(heading), ..Pose::default() };
            let least = see(&beams, &readings, pose);
            let whole = see_with(10_000, &beams, &readings, pose);
            assert!(least.free.symmetric_difference(&whole.free).count() <= 20);
            let near = |cells: &BTreeSet<(i32, i32)>, (x, y): (i32, i32)| {
                cells.range((x - 1, y - 1)..=(x + 1, y + 1)).any(|cell| cell.1.abs_diff(y) <= 1)
            };
            assert!(least.hit.iter().all(|&cell| near(&whole.hit, cell)));
            assert!(whole.hit.iter().all(|&cell| near(&least.hit, cell)));
            assert_eq!(least.counts.seen, whole.counts.seen);
        }
    }

    #[test]
    fn cells_covered_by_cameras_are_not_mapped() {
        const RANGE: u16 = 2_000;
        let mut beams = [Beam::default(); 90];
        let sensor = SensorModel::Radial { first: -1.5, step: 0.03 };
        fill_beams(&mut beams, sensor, Pose::default());
        let config = MappingConfig { max_range: RANGE, ..CONFIG };
        // Cells with an even x are covered.
        let even = [0x5555_5555; TILE_SIDE];
        let add = |covered: Option<&[u32; TILE_SIDE]>| {
            let mut scratch = vec![RowSighting::default(); scratch_words(RANGE, CONFIG.resolution)];
            let mut places = [OwnTile::FREE; 9];
            let mut map = LocalMap::new(config, &beams, &mut scratch, Pool::new(&mut places));
            let known = |_| Surround { covered, ..Surround::default() };
            let mapped = map.add(&beams, &[1_500; 90], (Pose::default(), u16::MAX), known).unwrap();
            let tiles = map.pool.tiles().map(|tile| (tile.id(), tile.evidence.cells()));
            (mapped.pixels, tiles.collect::<Vec<_>>())
        };
        let (everything, all) = add(None);
        assert_eq!((everything.kept, everything.omitted), (90, 0));
        let (_, odd) = add(Some(&even));
        assert_eq!(odd.len(), all.len());
        for ((id, odd), (_, all)) in odd.iter().zip(&all) {
            let masked = |plane: &[u32; TILE_SIDE]| plane.map(|row| row & !even[0]);
            assert_eq!((odd.low, odd.high), (masked(&all.low), masked(&all.high)), "{id:?}");
        }
        let (nothing, none) = add(Some(&[u32::MAX; TILE_SIDE]));
        assert_eq!((nothing.kept, nothing.omitted, none.len()), (0, 90, 0), "no tile is created");
    }
}
