//! A grid as pixels, and places of `map` on it.

use std::collections::HashMap;

use image::{Rgb, RgbImage};
use ubimap_protocol::tile::Cell;

use super::palette::{INK, UNKNOWN, are_alike};
use crate::grid::OccupancyGrid;

/// Unknown cells around the map.
pub(super) const MARGIN: usize = 4;

/// The longer side of a picture has about this many pixels, within the scales.
const SIDE: usize = 1200;
const SCALES: std::ops::RangeInclusive<usize> = 2..=8;

/// Past this many cells a cell is one pixel, and nothing separates colours that are alike: a line
/// would be a wall.
const MOST_SCALED_CELLS: usize = 1 << 22;

/// A picture of a grid with a margin.
pub(super) struct Canvas<'g> {
    pub(super) image: RgbImage,
    grid: &'g OccupancyGrid,
    /// Pixels of a cell.
    scale: usize,
}

/// Pixels of a cell in a picture of a whole grid: 2 to 8, 1 in that of a huge one.
pub(super) fn scale_of(grid: &OccupancyGrid) -> usize {
    if grid.width() * grid.height() > MOST_SCALED_CELLS {
        return 1;
    }
    let longer = grid.width().max(grid.height()) + 2 * MARGIN;
    (SIDE / longer).clamp(*SCALES.start(), *SCALES.end())
}

impl<'g> Canvas<'g> {
    /// Draws a grid. `colour` gives that of each cell, and of the cells of the margin.
    pub(super) fn new(
        grid: &'g OccupancyGrid,
        scale: usize,
        colour: impl Fn(usize, usize) -> Rgb<u8>,
    ) -> Self {
        let (columns, rows) = (grid.width() + 2 * MARGIN, grid.height() + 2 * MARGIN);
        // From the upper left on. West and south of the grid the subtraction wraps: outside.
        let cells = (0..columns * rows).map(|index| {
            let (column, row) = (index % columns, rows - 1 - index / columns);
            colour(column.wrapping_sub(MARGIN), row.wrapping_sub(MARGIN))
        });
        let cells = Cells { colours: cells.collect(), columns, rows };
        let mut alike = HashMap::new();
        let image = RgbImage::from_fn((columns * scale) as u32, (rows * scale) as u32, |x, y| {
            cells.pixel([x as usize, y as usize], scale, &mut alike)
        });
        Self { image, grid, scale }
    }

    /// The pixel of a point of `map`, in metres.
    pub(super) fn pixel(&self, point: [f64; 2]) -> [f64; 2] {
        let [column, row] = self.grid.from_map(point);
        let (margin, scale) = (MARGIN as f64, self.scale as f64);
        let height = f64::from(self.image.height());
        [(column + margin) * scale, height - (row + margin) * scale]
    }

    /// Whether the map says something of a point of `map`, in metres.
    pub(super) fn is_known(&self, point: [f64; 2]) -> bool {
        let [column, row] = self.grid.from_map(point);
        column >= 0.0
            && row >= 0.0
            && self.grid.cell(column as usize, row as usize) != Cell::Unknown
    }

    /// Pixels of a metre.
    pub(super) fn pixels_per_m(&self) -> f64 {
        self.scale as f64 / self.grid.resolution_m()
    }

    /// An angle of `map` as it is on the picture, where y points down: counter-clockwise from the
    /// right, in radians.
    pub(super) fn angle(&self, heading_rad: f64) -> f64 {
        heading_rad - self.grid.yaw_rad()
    }
}

/// The colours of cells, row by row from the upper left.
struct Cells {
    colours: Vec<Rgb<u8>>,
    columns: usize,
    rows: usize,
}

impl Cells {
    fn get(&self, column: usize, row: usize) -> Option<Rgb<u8>> {
        (column < self.columns && row < self.rows)
            .then(|| self.colours[row * self.columns + column])
    }

    /// The colour of a pixel: that of its cell, or a line towards a cell whose colour is too much
    /// like it. One of the two cells has the line.
    fn pixel(
        &self,
        [x, y]: [usize; 2],
        scale: usize,
        alike: &mut HashMap<[Rgb<u8>; 2], bool>,
    ) -> Rgb<u8> {
        let (column, row) = (x / scale, y / scale);
        let Some(own) = self.get(column, row) else { return UNKNOWN };
        // Which neighbours the pixel touches, by steps of a cell.
        let steps = |at: usize| -> &[isize] {
            match at % scale {
                _ if scale == 1 => &[0],
                0 => &[-1, 0],
                last if last == scale - 1 => &[0, 1],
                _ => &[0],
            }
        };
        for &down in steps(y) {
            for &across in steps(x) {
                let beside =
                    self.get(column.wrapping_add_signed(across), row.wrapping_add_signed(down));
                let Some(other) = beside.filter(|other| yields(own, *other)) else { continue };
                if *alike.entry([own, other]).or_insert_with(|| are_alike(own, other)) {
                    return INK;
                }
            }
        }
        own
    }
}

/// Which of two cells makes room for a line between them: what is unknown, that a single cell that
/// matters keeps its size.
fn yields(own: Rgb<u8>, other: Rgb<u8>) -> bool {
    own != other && (own == UNKNOWN || other != UNKNOWN && own.0 < other.0)
}
