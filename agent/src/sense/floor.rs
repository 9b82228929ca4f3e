//! The free floor in a grey image (Ahmed 2.1): its height above the bottom of the image, in pixels,
//! for each column.
//!
//! The paper segments the image and takes the region at the middle of its bottom; it does not
//! describe the segmentation. Here the floor grows from that region: along the bottom line to both
//! sides, then up each column while each pixel's grey level is near that of the pixels below. The
//! reference level follows the pixels slowly, so that gradients of light do not end the floor.
//! Several differing pixels in a row are needed to end it, so that noise and joints between tiles
//! do not end it either.
//!
//! The middle of the bottom line is assumed to be floor. If the robot stands right in front of a
//! wall, the wall passes for floor: a bumper must detect that.

use core::fmt;

/// Columns of an image (Ahmed, equation 1).
pub const COLUMNS: usize = 320;
/// Lines of an image.
pub const LINES: usize = 240;

/// Columns at the middle of the bottom line whose mean is the initial level of the floor.
const SEED: usize = 32;
/// Number of consecutive differing pixels that ends the floor.
const CONFIRMED: u8 = 3;
/// Fractional bits of the floor's grey level.
const FRACTION: u32 = 7;
/// Marks a column whose floor has ended: no pixel is within any tolerance of this level.
const ENDED: u16 = u16::MAX;
/// The level moves towards each pixel by 1/8 of the difference (a shift by 3).
const FOLLOW: u32 = 3;

/// Parameters of the segmentation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FloorConfig {
    /// Maximum difference between a pixel and the level of the floor below it, in grey levels.
    pub tolerance: u8,
    /// Number of lines processed, from the bottom. It should end at the horizon, as there is no
    /// floor above. The cost is proportional to it.
    pub lines: u8,
}

impl Default for FloorConfig {
    /// 20 grey levels, several times the noise of a cheap camera; 124 lines, the smallest number
    /// that detects a boundary at the far end of table 1 (121 pixels).
    fn default() -> Self {
        Self { tolerance: 20, lines: 121 + CONFIRMED }
    }
}

impl FloorConfig {
    /// The width of the tolerance band, in 1/128 levels.
    fn band(self) -> u32 {
        u32::from(self.tolerance) << (FRACTION + 1)
    }
}

/// The number of pixels of an image or a line is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageSizeError {
    /// Number of pixels required.
    pub expected: usize,
    /// Number of pixels received.
    pub found: usize,
}

impl fmt::Display for ImageSizeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the image has {} pixels instead of {}", self.found, self.expected)
    }
}

impl core::error::Error for ImageSizeError {}

/// The floor in one column.
#[derive(Clone, Copy, Debug)]
struct Column {
    /// The level of the floor, in 1/128 grey levels, or [`ENDED`].
    level: u16,
    /// The highest image line that is still floor; the bottom line is 1.
    distance: u8,
}

/// The floor of one image, fed line by line from the bottom, as cameras that can flip an image send
/// it. Needs only 1,280 bytes.
#[derive(Clone, Debug)]
pub struct Floor {
    config: FloorConfig,
    columns: [Column; COLUMNS],
    lines: u8,
}

impl Floor {
    /// The floor before the first line of an image.
    pub fn new(config: FloorConfig) -> Self {
        let column = Column { level: 0, distance: 0 };
        Self { config, columns: [column; COLUMNS], lines: 0 }
    }

    /// Whether this image needs further lines.
    pub fn wants_more(&self) -> bool {
        self.lines < self.config.lines
    }

    /// Processes the next line, starting at the bottom; lines beyond [`FloorConfig::lines`] are
    /// ignored. About 14 instructions per column.
    ///
    /// # Errors
    /// [`ImageSizeError`] if it does not have [`COLUMNS`] pixels; the state is unchanged.
    pub fn line(&mut self, line: &[u8]) -> Result<(), ImageSizeError> {
        let line: &[u8; COLUMNS] =
            line.try_into().map_err(|_| ImageSizeError { expected: COLUMNS, found: line.len() })?;
        if self.lines == 0 {
            self.seed(line);
        }
        if self.lines >= self.config.lines {
            return Ok(());
        }
        self.lines += 1;
        grow(&mut self.columns, line, self.config.band(), self.lines);
        Ok(())
    }

    /// The height of the floor in each column, in pixels from the bottom: 0 where there is no
    /// floor, the number of lines processed where the floor does not end. Boundaries narrower than
    /// three columns are filtered out (median of five).
    pub fn distances(&self) -> [u8; COLUMNS] {
        let raw = self.columns.each_ref().map(|column| column.distance);
        let mut distances = raw;
        for (distance, around) in distances.iter_mut().skip(2).zip(raw.windows(5)) {
            if let &[a, b, c, d, e] = around {
                *distance = median(a, b, c, d, e);
            }
        }
        distances
    }

    /// Sets the initial level of the floor in each column, from the middle of the bottom line
    /// outwards.
    fn seed(&mut self, line: &[u8; COLUMNS]) {
        let middle = line.iter().skip((COLUMNS - SEED) / 2).take(SEED);
        let sum: u32 = middle.map(|&pixel| u32::from(pixel)).sum();
        let seed = ((sum << FRACTION) / SEED as u32) as u16;
        let band = self.config.band();
        let spread = |level: &mut u16, column: &mut Column, pixel: u8| {
            *level = followed(*level, pixel, band).unwrap_or(*level);
            column.level = *level;
        };
        let mut level = seed;
        let left = self.columns.iter_mut().zip(line).take(COLUMNS / 2).rev();
        left.for_each(|(column, &pixel)| spread(&mut level, column, pixel));
        let mut level = seed;
        let right = self.columns.iter_mut().zip(line).skip(COLUMNS / 2);
        right.for_each(|(column, &pixel)| spread(&mut level, column, pixel));
    }
}

/// The floor of a whole image of [`COLUMNS`] x [`LINES`] pixels, top line first, as
/// [`Floor::distances`] returns it.
///
/// # Errors
/// [`ImageSizeError`].
pub fn floor_distances(image: &[u8], config: FloorConfig) -> Result<[u8; COLUMNS], ImageSizeError> {
    if image.len() != COLUMNS * LINES {
        return Err(ImageSizeError { expected: COLUMNS * LINES, found: image.len() });
    }
    let mut floor = Floor::new(config);
    for line in image.chunks_exact(COLUMNS).rev() {
        if !floor.wants_more() {
            break;
        }
        floor.line(line)?;
    }
    Ok(floor.distances())
}

/// Grows the floor by one line. A separate function, so that the whole loop stays in registers.
#[inline(never)]
fn grow(columns: &mut [Column; COLUMNS], line: &[u8; COLUMNS], band: u32, lines: u8) {
    for (column, &pixel) in columns.iter_mut().zip(line) {
        if let Some(level) = followed(column.level, pixel, band) {
            *column = Column { level, distance: lines };
        } else if lines - column.distance >= CONFIRMED {
            column.level = ENDED;
        }
    }
}

/// The level of the floor after a pixel. `None` if level and pixel differ by more than half of
/// `band`: the pixel is not floor.
fn followed(level: u16, pixel: u8, band: u32) -> Option<u16> {
    let off = (i32::from(pixel) << FRACTION) - i32::from(level);
    let near = off.wrapping_add((band / 2) as i32) as u32 <= band;
    near.then_some((i32::from(level) + (off >> FOLLOW)) as u16)
}

/// The median of five.
fn median(a: u8, b: u8, c: u8, d: u8, e: u8) -> u8 {
    // The minimum and the maximum of the first four can't be the median.
    let low = a.min(b).max(c.min(d));
    let high = a.max(b).min(c.max(d));
    low.min(high).max(e.min(low.max(high)))
}

#[cfg(test)]
mod tests {
    use std::{vec, vec::Vec};

    use super::*;
    use proptest::prelude::*;

    /// Floor with grey level 140 up to some line in each column, and level 70 above it.
    fn image(floor: impl Fn(usize) -> usize) -> Vec<u8> {
        let pixel =
            |line: usize, column: usize| if LINES - line <= floor(column) { 140 } else { 70 };
        (0..COLUMNS * LINES).map(|index| pixel(index / COLUMNS, index % COLUMNS)).collect()
    }

    fn distances(image: &[u8]) -> [u8; COLUMNS] {
        floor_distances(image, FloorConfig::default()).unwrap()
    }

    #[test]
    fn every_distance_is_found_up_to_the_last_line_processed() {
        for floor in 1..=LINES {
            let found = distances(&image(|_| floor));
            assert_eq!(found, [floor.min(124) as u8; COLUMNS]);
        }
        let all = FloorConfig { lines: 255, ..FloorConfig::default() };
        assert_eq!(floor_distances(&image(|_| LINES), all), Ok([LINES as u8; COLUMNS]));
    }

    #[test]
    fn objects_narrower_than_three_columns_or_lines_do_not_end_the_floor() {
        let mut spoiled = image(|column| if (40..42).contains(&column) { 30 } else { 100 });
        spoiled[(LINES - 50) * COLUMNS..][..2 * COLUMNS].fill(10);
        assert_eq!(distances(&spoiled), [100; COLUMNS]);
        let posts = image(|column| if (40..43).contains(&column) { 30 } else { 100 });
        let expected = core::array::from_fn(|it| if (40..43).contains(&it) { 30 } else { 100 });
        assert_eq!(distances(&posts), expected);
    }

    #[test]
    fn there_is_no_floor_behind_an_object_at_the_bottom() {
        let found = distances(&image(|column| if column < 60 { 0 } else { 90 }));
        assert_eq!(found, core::array::from_fn(|column| if column < 60 { 0 } else { 90 }));
    }

    #[test]
    fn images_of_another_size_are_refused_and_change_nothing() {
        let expected = COLUMNS * LINES;
        for found in [0, 1, COLUMNS, expected - 1, expected + 1] {
            let error = Err(ImageSizeError { expected, found });
            assert_eq!(floor_distances(&vec![0; found], FloorConfig::default()), error);
        }
        let mut floor = Floor::new(FloorConfig::default());
        assert_eq!(floor.line(&[0; 319]), Err(ImageSizeError { expected: 320, found: 319 }));
        assert_eq!(floor.distances(), [0; COLUMNS]);
        for line in image(|_| 77).chunks(COLUMNS).rev() {
            assert_eq!(floor.line(line), Ok(()));
        }
        assert_eq!(floor.distances(), [77; COLUMNS]);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn distances_of_any_image_are_bounded(
            bytes in proptest::collection::vec(any::<u8>(), COLUMNS * 3),
            tolerance in any::<u8>(), lines in any::<u8>(),
        ) {
            // Random lines in random order.
            let image: Vec<u8> = (0..LINES)
                .flat_map(|line| {
                    let from = usize::from(bytes[line]) % (2 * COLUMNS);
                    bytes[from..from + COLUMNS].to_vec()
                })
                .collect();
            let found = floor_distances(&image, FloorConfig { tolerance, lines }).unwrap();
            prop_assert!(found.iter().all(|&distance| distance <= lines.min(240)));
        }
    }
}
