//! Plane slicing: reduces a depth frame to one row of readings (Aluckal II.A).

use core::fmt;

use ubimap_protocol::units::Millimetres;

use super::{
    beams::SensorModel,
    camera::{Camera, Rays},
    level::LevelRow,
    validity::Validity,
};

/// Maximum number of rows for a median.
const MEDIAN_ROWS: usize = 5;

/// The part of a frame that becomes the readings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Slice {
    /// One row, as in the paper. On a tilted camera only [`Camera::level_row`] is a level slice.
    Row(u16),
    /// Several rows, combined to one reading per column. The points count as if they lay in the
    /// direction of the middle row.
    Band {
        /// The uppermost row.
        first: u16,
        /// Number of rows.
        rows: u16,
        /// Which reading of each column to use.
        pick: Pick,
    },
    /// The pixels at a given height, for a camera with any tilt. The row in which a height appears
    /// depends on the depth: a point at depth `Z` lies `Z * (sin pitch + cos pitch * (row - cy) /
    /// fy)` below the camera. So every pixel is compared with the height, and each column keeps the
    /// closest pixel. As the columns of a tilted image are not vertical, pixels are assigned to the
    /// columns of a level camera at the same place. The result is what a lidar at that height would
    /// see, except for occlusions.
    Height {
        /// Vertical distance of the height below the camera; negative if it is above the camera.
        below: Millimetres,
        /// Maximum vertical distance of a point from the height. It must be at least half the
        /// height of a row at the maximum depth (`Z / fy / 2`), or surfaces fall between two rows.
        tolerance: Millimetres,
    },
}

/// Which of several readings in a column to use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pick {
    /// The nearest: the first obstacle that a robot as high as the band would touch.
    Nearest,
    /// The median of at most five rows (of two: the nearer), which reduces noise.
    Median,
}

/// Why a frame can't be sliced.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SliceError {
    /// The line's length differs from the configured width.
    Width {
        /// Number of readings required.
        expected: usize,
        /// Number of readings received.
        found: usize,
    },
    /// The buffer is too short; it needs this many readings.
    Buffer(usize),
    /// A band without rows, or a median of more than five.
    Rows(u16),
    /// The frame ended with this many rows of the slice missing.
    Incomplete(u16),
}

impl fmt::Display for SliceError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Width { expected, found } => {
                write!(f, "the line has {found} readings instead of {expected}")
            }
            Self::Buffer(needed) => {
                write!(f, "the slicer's buffer is too short: it needs {needed} readings")
            }
            Self::Rows(rows) => {
                write!(f, "a slice can't have {rows} rows (a median at most {MEDIAN_ROWS})")
            }
            Self::Incomplete(missing) => {
                write!(f, "the frame ended with {missing} rows of the slice missing")
            }
        }
    }
}

impl core::error::Error for SliceError {}

impl Slice {
    /// The geometry of the slice's readings, for [`Config::sensor`](crate::Config::sensor).
    pub fn sensor(self, camera: Camera) -> SensorModel {
        match self {
            Self::Row(row) => SensorModel::Row { camera, row: f32::from(row) },
            Self::Band { first, rows, .. } => {
                let middle = f32::from(first) + (f32::from(rows) - 1.0) / 2.0;
                SensorModel::Row { camera, row: middle }
            }
            Self::Height { .. } => {
                SensorModel::Pinhole { focal: camera.focal.0, centre: camera.centre.0 }
            }
        }
    }

    /// Size of a slicer's buffer for frames of this width, in readings.
    pub const fn buffer_len(self, width: usize) -> usize {
        match self {
            Self::Row(_) | Self::Band { pick: Pick::Nearest, .. } => width,
            Self::Band { rows, pick: Pick::Median, .. } => width.saturating_mul(rows as usize),
            Self::Height { .. } => width.saturating_mul(2),
        }
    }

    /// The first row and the number of rows of the slice; (0, 0) for a height, which uses all rows.
    fn rows(self) -> (u16, u16) {
        match self {
            Self::Row(row) => (row, 1),
            Self::Band { first, rows, .. } => (first, rows),
            Self::Height { .. } => (0, 0),
        }
    }
}

/// Slices frames line by line, so that no frame is ever held whole:
///
/// ```
/// # use ubimap_agent::sense::{Camera, Pick, Slice, Slicer, Validity};
/// # let frame = [1_000u16; 8 * 8];
/// let camera = Camera::new((9.7, 9.7), (3.5, 3.5));
/// const SLICE: Slice = Slice::Band { first: 3, rows: 2, pick: Pick::Nearest };
/// let mut buffer = [0; SLICE.buffer_len(8)];
/// let mut slicer = Slicer::new(SLICE, camera, 8, Validity::default(), &mut buffer)?;
/// for (row, line) in frame.chunks(8).enumerate() {
///     slicer.line(row as u16, line)?;
/// }
/// let readings = slicer.finish()?; // for `Robot::scan`
/// # assert_eq!(readings, [1_000; 8]);
/// # Ok::<(), ubimap_agent::sense::SliceError>(())
/// ```
///
/// A single row of a frame in memory needs no slicer: pass it to `Robot::scan` directly.
#[derive(Debug)]
pub struct Slicer<'b> {
    slice: Slice,
    rays: Rays,
    width: usize,
    validity: Validity,
    buffer: &'b mut [u16],
    /// The smallest row index that continues this frame: a smaller one begins another. `None`
    /// before the first row of a frame.
    next: Option<u16>,
    /// Number of rows of the slice received.
    taken: u16,
}

impl<'b> Slicer<'b> {
    /// A slicer for frames `width` pixels wide. Readings that `validity` excludes are never picked.
    ///
    /// # Errors
    /// [`SliceError::Buffer`], [`SliceError::Rows`].
    pub fn new(
        slice: Slice,
        camera: Camera,
        width: usize,
        validity: Validity,
        buffer: &'b mut [u16],
    ) -> Result<Self, SliceError> {
        if let Slice::Band { rows, pick, .. } = slice
            && (rows == 0 || pick == Pick::Median && usize::from(rows) > MEDIAN_ROWS)
        {
            return Err(SliceError::Rows(rows));
        }
        let needed = slice.buffer_len(width);
        let buffer = buffer.get_mut(..needed).ok_or(SliceError::Buffer(needed))?;
        let rays = Rays::new(camera, width);
        Ok(Self { slice, rays, width, validity, buffer, next: None, taken: 0 })
    }

    /// Processes a line of the frame: depths in millimetres, 0 for no return. Lines come from top
    /// to bottom; lines outside the slice may be left out. A line that is not below the previous
    /// one begins another frame, and the unfinished one is dropped. Cost on a Cortex-M4: about 25
    /// instructions per pixel for the nearest, 55 for a median, 65 for a height.
    ///
    /// # Errors
    /// [`SliceError::Width`]; the line is ignored.
    pub fn line(&mut self, row: u16, readings: &[u16]) -> Result<(), SliceError> {
        if readings.len() != self.width {
            return Err(SliceError::Width { expected: self.width, found: readings.len() });
        }
        if self.next.is_none_or(|next| row < next) {
            self.begin();
        }
        self.next = Some(row.saturating_add(1));
        let (first, rows) = self.slice.rows();
        let place = row.checked_sub(first).filter(|&place| place < rows);
        match (self.slice, place) {
            (Slice::Height { below, tolerance }, _) => {
                if let Some((level, misses)) = self.buffer.split_at_mut_checked(self.width) {
                    let height = (below.0, tolerance.0);
                    let mut level = LevelRow { readings: level, misses };
                    level.hold((&self.rays, row), readings, height, &self.validity);
                }
            }
            (_, None) => return Ok(()),
            (Slice::Row(_), Some(_)) => copy(self.buffer, readings),
            (Slice::Band { pick: Pick::Nearest, .. }, Some(_)) => {
                for (nearest, &reading) in self.buffer.iter_mut().zip(readings) {
                    // The wrapping subtraction makes 0 (no reading) the farthest.
                    if self.validity.counts(reading) && reading <= nearest.wrapping_sub(1) {
                        *nearest = reading;
                    }
                }
            }
            (Slice::Band { pick: Pick::Median, .. }, Some(place)) => {
                let from = usize::from(place) * self.width;
                copy(self.buffer.get_mut(from..).unwrap_or_default(), readings);
            }
        }
        self.taken = self.taken.saturating_add(1);
        Ok(())
    }

    /// Slices a whole frame, row by row.
    ///
    /// # Errors
    /// [`SliceError::Width`] if its last line is shorter than the others,
    /// [`SliceError::Incomplete`].
    pub fn frame(&mut self, depths: &[u16]) -> Result<&[u16], SliceError> {
        self.discard();
        for (row, line) in (0..=u16::MAX).zip(depths.chunks(self.width.max(1))) {
            self.line(row, line)?;
        }
        self.finish()
    }

    /// Number of pixels per line.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Whether the frame has all lines of the slice. Lines of a [`Slice::Height`] are not counted,
    /// because only the caller knows the number of lines of a frame.
    pub fn is_complete(&self) -> bool {
        self.missing() == 0
    }

    /// Number of lines of the slice that are missing; at least one if the frame has not begun.
    fn missing(&self) -> u16 {
        let (_, rows) = self.slice.rows();
        if self.next.is_none() { rows.max(1) } else { rows.saturating_sub(self.taken) }
    }

    /// The readings of the finished frame, one per column. The next line begins another frame.
    /// [`Validity`] has not been applied to the readings as a row yet; the robot does that.
    ///
    /// # Errors
    /// [`SliceError::Incomplete`]
    pub fn finish(&mut self) -> Result<&[u16], SliceError> {
        let missing = self.missing();
        self.discard();
        if missing > 0 {
            return Err(SliceError::Incomplete(missing));
        }
        if let Slice::Band { pick: Pick::Median, .. } = self.slice {
            self.median();
        }
        Ok(self.buffer.get(..self.width).unwrap_or_default())
    }

    /// Drops the unfinished frame. Call this when lines were lost: only a sensor's driver knows
    /// whether the next line belongs to the same frame.
    pub fn discard(&mut self) {
        self.next = None;
    }

    /// Begins a frame.
    fn begin(&mut self) {
        self.taken = 0;
        self.buffer.fill(0);
        if let Slice::Height { tolerance, .. } = self.slice {
            let worst = tolerance.0.clamp(0, 65_534) as u16 + 1;
            self.buffer.get_mut(self.width..).unwrap_or_default().fill(worst);
        }
    }

    /// Computes the median of each column into the first row.
    fn median(&mut self) {
        for column in 0..self.width {
            let mut count = 0_usize;
            let readings = [0, 1, 2, 3, 4].map(|row| {
                let reading = self.buffer.get(row * self.width + column).map_or(0, |&it| it);
                let counts = self.validity.counts(reading);
                count += usize::from(counts);
                if counts { reading } else { u16::MAX }
            });
            let median = sorted(readings).get(count.saturating_sub(1) / 2).map_or(0, |&it| it);
            if let Some(place) = self.buffer.get_mut(column) {
                *place = if count == 0 { 0 } else { median };
            }
        }
    }
}

/// Sorts five readings with the shortest sorting network.
fn sorted([a, b, c, d, e]: [u16; MEDIAN_ROWS]) -> [u16; MEDIAN_ROWS] {
    let order = |a: u16, b: u16| (a.min(b), a.max(b));
    let ((a, b), (d, e)) = (order(a, b), order(d, e));
    let (c, e) = order(c, e);
    let (c, d) = order(c, d);
    let (b, e) = order(b, e);
    let (a, d) = order(a, d);
    let (a, c) = order(a, c);
    let (b, d) = order(b, d);
    let (b, c) = order(b, c);
    [a, b, c, d, e]
}

fn copy(to: &mut [u16], from: &[u16]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to = *from);
}

#[cfg(test)]
mod tests {
    use std::{vec, vec::Vec};

    use super::*;
    use crate::sense::Distortion;
    use proptest::prelude::*;

    const CAMERA: Camera = Camera::new((343.1, 343.1), (319.5, 239.5));
    /// Mounting height of the cameras in these tests, in millimetres.
    const MOUNTED: f64 = 300.0;

    /// The depths of a frame: a floor, and a vertical wall whose nearest point is `distance` mm
    /// away at `bearing`, or no wall if `None`.
    fn frame(
        camera: Camera,
        (width, height): (usize, usize),
        wall: Option<(f64, f64)>,
    ) -> Vec<u16> {
        let rays = Rays::new(camera, width);
        let pixels = (0..height).flat_map(|row| (0..width).map(move |column| (column, row)));
        let depth = |(column, row): (usize, usize)| {
            let ray = rays.at(column as f32, row as f32)?;
            let floor = MOUNTED / f64::from(ray.down);
            let wall = wall.map_or(f64::INFINITY, |(distance, bearing)| {
                let (forward, left) = (f64::from(ray.forward), f64::from(ray.left));
                distance / (forward * bearing.cos() + left * bearing.sin())
            });
            let first = [floor, wall].into_iter().filter(|&depth| depth > 0.0);
            let first = first.fold(f64::INFINITY, f64::min);
            (first < 60_000.0).then_some(first.round() as u16)
        };
        pixels.map(|pixel| depth(pixel).unwrap_or(0)).collect()
    }

    fn slice(slice: Slice, camera: Camera, width: usize, frame: &[u16]) -> Vec<u16> {
        let mut buffer = vec![9; slice.buffer_len(width)];
        let mut slicer =
            Slicer::new(slice, camera, width, Validity::default(), &mut buffer).unwrap();
        slicer.frame(frame).unwrap().to_vec()
    }

    #[test]
    fn a_row_slice_is_that_row() {
        let frame: Vec<u16> = (0..12).collect();
        assert_eq!(slice(Slice::Row(1), CAMERA, 4, &frame), [4, 5, 6, 7]);
    }

    #[test]
    fn a_band_gives_the_nearest_or_the_median_of_its_returns() {
        let frame = [
            [7, 0, 9, 30_000, 0, 1],
            [500, 0, 700, 900, 300, 1_200],
            [400, 0, 0, 65_535, 0, 1_000],
            [300, 0, 600, 800, 0, 1_100],
            [1, 1, 1, 1, 1, 1],
        ];
        let of = |pick| Slice::Band { first: 1, rows: 3, pick };
        let frame = frame.as_flattened();
        assert_eq!(slice(of(Pick::Nearest), CAMERA, 6, frame), [300, 0, 600, 800, 300, 1_000]);
        assert_eq!(slice(of(Pick::Median), CAMERA, 6, frame), [400, 0, 600, 800, 300, 1_100]);
    }

    #[test]
    fn the_sorting_network_sorts() {
        // A network that sorts every sequence of zeros and ones sorts every sequence.
        for bits in 0..32u16 {
            let row = [0, 1, 2, 3, 4].map(|place| bits >> place & 1);
            let mut expected = row;
            expected.sort();
            assert_eq!(sorted(row), expected);
        }
    }

    #[test]
    fn malformed_frames_are_refused_and_the_next_frame_is_read() {
        let camera = CAMERA;
        let band = |rows, pick| Slice::Band { first: 1, rows, pick };
        let mut buffer = [0; 9];
        let mut new = |slice| Slicer::new(slice, camera, 3, Validity::default(), &mut buffer).err();
        assert_eq!(new(band(0, Pick::Nearest)), Some(SliceError::Rows(0)));
        assert_eq!(new(band(6, Pick::Median)), Some(SliceError::Rows(6)));
        assert_eq!(new(band(4, Pick::Median)), Some(SliceError::Buffer(12)));
        let slice = band(3, Pick::Median);
        let mut slicer = Slicer::new(slice, camera, 3, Validity::default(), &mut buffer).unwrap();
        assert_eq!(slicer.finish(), Err(SliceError::Incomplete(3)));
        assert_eq!(slicer.line(1, &[1, 2, 3]), Ok(()));
        assert_eq!(slicer.line(2, &[1, 2]), Err(SliceError::Width { expected: 3, found: 2 }));
        assert_eq!(slicer.line(3, &[1, 2, 3]), Ok(()));
        assert_eq!(slicer.finish(), Err(SliceError::Incomplete(1)));
        assert_eq!(slicer.frame(&[1; 13]), Err(SliceError::Width { expected: 3, found: 1 }));
        let frame: Vec<u16> = (1..16).collect();
        assert_eq!(slicer.frame(&frame), Ok(&[7, 8, 9][..]));
        assert_eq!(slicer.frame(&[]), Err(SliceError::Incomplete(3)));
    }

    /// A frame of a 4 x 6 sensor is cut after any line, and the next one is whole: its slice has
    /// none of the first one's readings.
    #[test]
    fn a_frame_that_is_cut_leaves_nothing_in_the_next_one() {
        let below = Millimetres(0);
        let slices = [
            Slice::Row(3),
            Slice::Band { first: 1, rows: 3, pick: Pick::Nearest },
            Slice::Band { first: 1, rows: 3, pick: Pick::Median },
            Slice::Height { below, tolerance: Millimetres(60_000) },
        ];
        for slice in slices {
            let mut buffer = vec![0; slice.buffer_len(4)];
            let camera = Camera::new((4.0, 4.0), (1.5, 2.5));
            let mut slicer =
                Slicer::new(slice, camera, 4, Validity::default(), &mut buffer).unwrap();
            let whole = slicer.frame(&[2_000; 24]).unwrap().to_vec();
            for cut in 0..6 {
                (0..cut).for_each(|row| slicer.line(row, &[300; 4]).unwrap());
                (0..6).for_each(|row| slicer.line(row, &[2_000; 4]).unwrap());
                assert_eq!(slicer.finish(), Ok(&whole[..]), "{slice:?}, cut after {cut} lines");
                slicer.line(5, &[300; 4]).unwrap();
                slicer.discard();
                assert!(slicer.finish().is_err());
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(30))]

        /// With any tilt and lens, a slice at any height shows the wall where a level camera at the
        /// same place would see it.
        #[test]
        fn a_height_slice_shows_the_wall_where_it_stands(
            pitch in -0.1f32..0.5, roll in -0.2f32..0.2,
            k1 in -0.15f32..0.15, p1 in -0.002f32..0.002,
            distance in 900.0f64..2_500.0, bearing in -0.3f64..0.3, below in -50i32..250,
        ) {
            let distortion = Distortion { k1, p1, ..Distortion::default() };
            let camera = Camera { pitch, roll, distortion, ..CAMERA };
            let frame = frame(camera, (640, 480), Some((distance, bearing)));
            let height = Slice::Height { below: Millimetres(below), tolerance: Millimetres(10) };
            let readings = slice(height, camera, 640, &frame);
            for (column, &reading) in readings.iter().enumerate().filter(|(_, r)| **r != 0) {
                let aside = (319.5 - column as f64) / 343.1;
                let facing = bearing.cos() + aside * bearing.sin();
                let truth = distance / facing;
                // The tolerance covers rounding, and one pixel on a wall seen at a slant.
                let pixel = truth * (bearing.sin() / facing).abs() / 343.1;
                prop_assert!(
                    (f64::from(reading) - truth).abs() < 3.0 + 1.2 * pixel,
                    "column {column}: {reading} instead of {truth}"
                );
            }
            // Every column with a pixel at the height has a reading.
            let rays = Rays::new(camera, 640);
            for (index, &depth) in frame.iter().enumerate().filter(|(_, depth)| **depth != 0) {
                let (column, row) = (index % 640, index / 640);
                let ray = rays.at(column as f32, row as f32).unwrap();
                let off = f64::from(ray.down) * f64::from(depth) - f64::from(below);
                let level = rays.level_column(&ray);
                // At the very edge the centre of the column may lie outside the image.
                let is_shown = (1..639).contains(&column) && (0.0..639.0).contains(&level);
                if off.abs() < 5.0 && is_shown {
                    prop_assert_ne!(readings[level.round() as usize], 0, "column {}", level);
                }
            }
        }
    }

    #[test]
    fn a_height_slice_ignores_the_floor() {
        let camera = Camera { pitch: 0.3, ..CAMERA };
        let frame = frame(camera, (640, 480), None);
        let at = |below| {
            let slice_at = Slice::Height { below: Millimetres(below), tolerance: Millimetres(30) };
            let readings = slice(slice_at, camera, 640, &frame);
            readings.iter().filter(|&&reading| reading != 0).count()
        };
        assert_eq!((at(200), at(0), at(300)), (0, 0, 640));
    }

    #[test]
    fn small_sensors_are_sliced_by_the_same_code() {
        // 8 x 8 zones over 45 degrees, level, 300 mm above the floor, a wall at 1.5 m.
        let small = Camera::new((9.66, 9.66), (3.5, 3.5));
        let depths = frame(small, (8, 8), Some((1_500.0, 0.0)));
        let band = Slice::Band { first: 3, rows: 2, pick: Pick::Median };
        assert_eq!(slice(band, small, 8, &depths), [1_500; 8]);
        let height = Slice::Height { below: Millimetres(100), tolerance: Millimetres(80) };
        assert_eq!(slice(height, small, 8, &depths), [1_500; 8]);
        // 100 x 100 pixels over 78 degrees, tilted 20 degrees down.
        let tilted = Camera { pitch: 0.35, ..Camera::new((61.7, 61.7), (49.5, 49.5)) };
        let depths = frame(tilted, (100, 100), Some((1_500.0, 0.0)));
        let height = Slice::Height { below: Millimetres(200), tolerance: Millimetres(20) };
        let readings = slice(height, tilted, 100, &depths);
        // At this height the outermost columns of the level camera lie outside the image.
        assert!(readings[1..99].iter().all(|&it| it.abs_diff(1_500) <= 2), "{readings:?}");
        // On the optical axis the row sees the floor instead of the wall.
        let axis = slice(Slice::Row(50), tilted, 100, &depths);
        assert!(axis.iter().all(|&reading| reading < 900));
    }

    #[test]
    fn readings_come_with_their_sensor_model() {
        let band = Slice::Band { first: 3, rows: 2, pick: Pick::Nearest };
        assert_eq!(band.sensor(CAMERA), SensorModel::Row { camera: CAMERA, row: 3.5 });
        let height = Slice::Height { below: Millimetres(0), tolerance: Millimetres(20) };
        let level = SensorModel::Pinhole { focal: 343.1, centre: 319.5 };
        assert_eq!(height.sensor(CAMERA), level);
    }
}
