//! The rays of a fixed depth camera's pixels in the coordinates of the map's cells, computed once.

use ubimap_protocol::units::Millimetres;

use super::depth_sigma::DepthSigma;
use crate::camera::{DepthNoise, Lens};

/// Fixed-point fractions: positions along a ray in 2^-24 of a cell, heights in 2^-16 mm.
const CELL_SHIFT: u32 = 24;
const HEIGHT_SHIFT: u32 = 16;

/// Settings of perception that all cameras share.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Survey {
    /// The side of a cell.
    pub side: Millimetres,
    /// Clearance height: obstacles above it do not block robots.
    pub robot_height: Millimetres,
    /// Points within this distance of `map`'s plane are floor.
    pub floor_tolerance: Millimetres,
    /// Greater depths are ignored.
    pub reach: Millimetres,
}

impl Default for Survey {
    fn default() -> Self {
        Self {
            side: Millimetres(50),
            robot_height: Millimetres(400),
            floor_tolerance: Millimetres(30),
            reach: Millimetres(8_000),
        }
    }
}

/// The location of a pixel's point: a cell and a height zone. Cells are numbered row by row from
/// the south-west.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Zone {
    /// No measurement, or a point below the floor or beyond the reach.
    Nowhere,
    /// On the floor of a cell.
    Floor(u32),
    /// An obstacle at this height in millimetres, low enough to block robots.
    Band(u32, u16),
    /// A point higher than the robots, at this height in millimetres.
    Above(u32, u16),
}

/// The noise of heights that counts as floor, in thousandths of sigma: 96 % of the floor's points lie
/// below it.
const FLOOR_NOISE: i64 = 1_720;

/// The noise of a depth that is allowed for. Points within the floor tolerance plus [`FLOOR_NOISE`]
/// count as floor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Allowance {
    /// No noise.
    None,
    /// A mean whose standard error is half a cell.
    Learnt,
    /// A single measurement.
    Measured,
    /// The mean of this number of measurements.
    Mean(u32),
}

/// The step along one pixel's ray per millimetre of depth, in fixed point.
#[derive(Clone, Copy, Debug)]
struct Ray {
    x: i32,
    y: i32,
    up: i32,
}

/// The ray of each pixel of one depth camera, over the rectangle of cells that it can see.
#[derive(Clone, Debug)]
pub struct RayTable {
    survey: Survey,
    sigma: DepthSigma,
    size: (u32, u32),
    rays: Vec<Ray>,
    /// For each cell, the number of pixels whose rays meet the floor in it.
    expected: Vec<u32>,
    /// The grid coordinates in `map` of the south-western cell.
    first: (i32, i32),
    columns: u32,
    rows: u32,
    /// The optical centre, relative to the corner of the south-western cell.
    eye: (i64, i64),
    eye_height: i64,
}

impl RayTable {
    /// The rays of a depth sensor. Costs about 50 ns per pixel, more if the lens distorts. Size: 12
    /// bytes per pixel.
    pub fn new(lens: &Lens, noise: &DepthNoise, survey: Survey) -> Self {
        let intrinsics = lens.intrinsics();
        let size = (intrinsics.width, intrinsics.height);
        let side_mm = f64::from(survey.side.0.max(1));
        let reach_mm = f64::from(survey.reach.0.clamp(1, i32::from(u16::MAX)));
        let eye_mm = lens.centre().coords * 1000.0;
        let directions: Vec<_> = (0..size.1)
            .flat_map(|row| (0..size.0).map(move |column| [f64::from(column), f64::from(row)]))
            .map(|pixel| lens.direction(pixel))
            .collect();
        // Each ray ends at the floor or at the reach. The camera itself is in the rectangle, too.
        let mut low = [eye_mm.x, eye_mm.y];
        let mut high = low;
        for direction in &directions {
            let floor = if direction.z < 0.0 { eye_mm.z / -direction.z } else { reach_mm };
            let depth = if floor > 0.0 { floor.min(reach_mm) } else { reach_mm };
            for axis in 0..2 {
                let end = eye_mm[axis] + direction[axis] * depth;
                low[axis] = low[axis].min(end);
                high[axis] = high[axis].max(end);
            }
        }
        let cell = |mm: f64| (mm / side_mm).floor() as i32;
        let first = (cell(low[0]) - 1, cell(low[1]) - 1);
        let columns = (cell(high[0]) + 2 - first.0).unsigned_abs();
        let rows = (cell(high[1]) + 2 - first.1).unsigned_abs();
        let fixed = |value: f64, shift: u32| (value * f64::from(1_u32 << shift)).round();
        let eye = (
            fixed(eye_mm.x / side_mm - f64::from(first.0), CELL_SHIFT) as i64,
            fixed(eye_mm.y / side_mm - f64::from(first.1), CELL_SHIFT) as i64,
        );
        let ray = |direction: &nalgebra::Vector3<f64>| Ray {
            x: fixed(direction.x / side_mm, CELL_SHIFT) as i32,
            y: fixed(direction.y / side_mm, CELL_SHIFT) as i32,
            up: fixed(direction.z, HEIGHT_SHIFT) as i32,
        };
        let table = Self {
            survey,
            sigma: DepthSigma::of(noise),
            size,
            rays: directions.iter().map(ray).collect(),
            expected: Vec::new(),
            first,
            columns,
            rows,
            eye,
            eye_height: fixed(eye_mm.z, HEIGHT_SHIFT) as i64,
        };
        let mut expected = vec![0; table.cells()];
        for cell in table.rays.iter().filter_map(|ray| table.floor_under(*ray)) {
            expected[cell as usize] += 1;
        }
        Self { expected, ..table }
    }

    /// Width and height of the image in pixels.
    pub fn size(&self) -> (u32, u32) {
        self.size
    }

    pub(super) fn survey(&self) -> Survey {
        self.survey
    }

    pub(super) fn pixels(&self) -> usize {
        self.rays.len()
    }

    /// Number of cells in the rectangle.
    pub fn cells(&self) -> usize {
        (self.columns * self.rows) as usize
    }

    /// Number of pixels that see the floor of a cell if nothing occludes it.
    pub(super) fn expected(&self, cell: usize) -> u32 {
        self.expected[cell]
    }

    /// The grid coordinates of a cell in `map`.
    pub(super) fn in_map(&self, cell: usize) -> (i32, i32) {
        let columns = self.columns as usize;
        let (x, y) = (cell % columns, cell / columns);
        (self.first.0 + x as i32, self.first.1 + y as i32)
    }

    /// The index of a cell of `map`, if it is in the rectangle.
    pub(super) fn index(&self, (x, y): (i32, i32)) -> Option<usize> {
        let column = u32::try_from(x - self.first.0).ok().filter(|it| *it < self.columns)?;
        let row = u32::try_from(y - self.first.1).ok().filter(|it| *it < self.rows)?;
        Some((row * self.columns + column) as usize)
    }

    /// The cell below the camera, in the coordinates of `map`.
    pub(super) fn foot(&self) -> (i32, i32) {
        let cells = |fixed: i64| (fixed >> CELL_SHIFT) as i32;
        (self.first.0 + cells(self.eye.0), self.first.1 + cells(self.eye.1))
    }

    /// The standard deviation of a measured depth, both in millimetres.
    #[inline]
    pub(super) fn sigma_mm(&self, depth: u16) -> i64 {
        self.sigma.mm(depth)
    }

    /// Where a pixel's point lies at a depth in millimetres.
    #[inline]
    pub(super) fn zone(&self, pixel: usize, depth: u16, allowance: Allowance) -> Zone {
        let ray = self.rays[pixel];
        let millimetres = i64::from(depth);
        if depth == 0 || millimetres > i64::from(self.survey.reach.0) {
            return Zone::Nowhere;
        }
        let up = i64::from(ray.up);
        let height = (self.eye_height + up * millimetres) >> HEIGHT_SHIFT;
        let sigma = match allowance {
            Allowance::None => 0,
            Allowance::Learnt => self.sigma_mm(depth).min(i64::from(self.survey.side.0) / 2),
            Allowance::Measured => self.sigma_mm(depth),
            Allowance::Mean(count) => self.sigma_mm(depth) / i64::from(count.isqrt().max(1)),
        };
        let noise = (FLOOR_NOISE * sigma * up.abs() / 1_000) >> HEIGHT_SHIFT;
        let tolerance = i64::from(self.survey.floor_tolerance.0) + noise;
        let Some(cell) = self.cell(ray, millimetres).filter(|_| height >= -tolerance) else {
            return Zone::Nowhere;
        };
        if height <= tolerance {
            return Zone::Floor(cell);
        }
        let millimetres = height.min(i64::from(u16::MAX)) as u16;
        if height <= i64::from(self.survey.robot_height.0) {
            Zone::Band(cell, millimetres)
        } else {
            Zone::Above(cell, millimetres)
        }
    }

    #[inline]
    fn cell(&self, ray: Ray, depth: i64) -> Option<u32> {
        let x = (self.eye.0 + i64::from(ray.x) * depth) >> CELL_SHIFT;
        let y = (self.eye.1 + i64::from(ray.y) * depth) >> CELL_SHIFT;
        // Negative coordinates become large as unsigned numbers.
        let is_inside = (x as u64) < u64::from(self.columns) && (y as u64) < u64::from(self.rows);
        is_inside.then(|| y as u32 * self.columns + x as u32)
    }

    /// The cell in which a ray meets the floor.
    fn floor_under(&self, ray: Ray) -> Option<u32> {
        if ray.up >= 0 || self.eye_height <= 0 {
            return None;
        }
        let depth = self.eye_height / -i64::from(ray.up);
        self.cell(ray, depth).filter(|_| depth <= i64::from(self.survey.reach.0))
    }
}
