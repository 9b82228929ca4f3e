//! Draws a grid as pixels, and maps points of `map` to pixels.

use std::collections::HashMap;

use image::{Rgb, RgbImage};
use ubimap_protocol::tile::Cell;

use super::palette::{INK, UNKNOWN, are_alike};
use crate::grid::OccupancyGrid;

/// Width of the margin around the map, in cells.
pub(super) const MARGIN: usize = 4;

/// Approximate length of the longer side of a picture in pixels, before rounding to a scale.
const SIDE: usize = 1200;
const SCALES: std::ops::RangeInclusive<usize> = 2..=8;

/// Maximum number of cells in a map whose cells are drawn with more than one pixel. In larger maps
/// there are no lines between similar colours, since a line would look like a wall.
const MOST_SCALED_CELLS: usize = 1 << 22;

/// A picture of a grid with a margin.
pub(super) struct Canvas<'g> {
    pub(super) image: RgbImage,
    grid: &'g OccupancyGrid,
    /// Side of a cell in pixels.
    scale: usize,
}

/// Side of a cell in pixels in a picture of a whole grid: 2 to 8, or 1 for a huge grid.
pub(super) fn scale_of(grid: &OccupancyGrid) -> usize {
    if grid.width() * grid.height() > MOST_SCALED_CELLS {
        return 1;
    }
    let longer = grid.width().max(grid.height()) + 2 * MARGIN;
    (SIDE / longer).clamp(*SCALES.start(), *SCALES.end())
}

impl<'g> Canvas<'g> {
    /// Draws a grid. `colour` returns the colour of each cell, including those of the margin.
    pub(super) fn new(
        grid: &'g OccupancyGrid,
        scale: usize,
        colour: impl Fn(usize, usize) -> Rgb<u8>,
    ) -> Self {
        let (columns, rows) = (grid.width() + 2 * MARGIN, grid.height() + 2 * MARGIN);
        // From the upper left. The subtraction wraps for cells west and south of the grid, so that
        // these are outside of the grid, too.
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

    /// Whether the cell at a point of `map`, in metres, is known.
    pub(super) fn is_known(&self, point: [f64; 2]) -> bool {
        let [column, row] = self.grid.from_map(point);
        column >= 0.0
            && row >= 0.0
            && self.grid.cell(column as usize, row as usize) != Cell::Unknown
    }

    /// Pixels per metre.
    pub(super) fn pixels_per_m(&self) -> f64 {
        self.scale as f64 / self.grid.resolution_m()
    }

    /// Converts an angle in `map` to an angle in the picture, counter-clockwise from the right,
    /// both in radians.
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

    /// The colour of a pixel: that of its cell, or black along the border to a cell of too similar
    /// a colour. The black line is drawn in only one of the two cells. `alike` caches which pairs
    /// of colours are too similar.
    fn pixel(
        &self,
        [x, y]: [usize; 2],
        scale: usize,
        alike: &mut HashMap<[Rgb<u8>; 2], bool>,
    ) -> Rgb<u8> {
        let (column, row) = (x / scale, y / scale);
        let Some(own) = self.get(column, row) else { return UNKNOWN };
        // The neighbouring cells that the pixel touches, as index offsets.
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

/// Whether a line between two cells is drawn in the first one, with the colour `own`. An unknown
/// cell always gets the line, so that a single known cell keeps its size.
fn yields(own: Rgb<u8>, other: Rgb<u8>) -> bool {
    own != other && (own == UNKNOWN || other != UNKNOWN && own.0 < other.0)
}
