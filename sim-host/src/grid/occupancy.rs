//! A map as one rectangle of cells.

use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, Tile, TileId},
    units::Millimetres,
};

/// Maximum number of cells of a grid: 290 m square at 5 cm.
pub const MAX_CELLS: usize = 1 << 25;

/// Why a grid can't be created.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GridError {
    /// More cells than [`MAX_CELLS`].
    #[error(
        "a map of {width} x {height} cells is too large (the limit is {MAX_CELLS} cells): \
         use a coarser resolution"
    )]
    TooLarge {
        /// Cells along x.
        width: u64,
        /// Cells along y.
        height: u64,
    },
    /// The resolution is zero, negative or not a number.
    #[error("a resolution of {0} m is not a positive length")]
    Resolution(f64),
    /// A coordinate of the origin is not finite.
    #[error("the origin [{0}, {1}] m, yaw {2} rad is not finite")]
    Origin(f64, f64, f64),
}

/// Number of cells of a grid by state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CellCounts {
    /// Free or occupied.
    pub known: usize,
    /// Free.
    pub free: usize,
    /// Occupied, fixed or movable.
    pub occupied: usize,
}

/// A rectangle of cells, row by row from the south (minimum y), each row from the west (minimum x).
///
/// Its lower left corner is at `origin_m` in `map`, and the rectangle is rotated about that corner by
/// `yaw_rad`, counter-clockwise. It has at least one cell.
#[derive(Clone, Debug, PartialEq)]
pub struct OccupancyGrid {
    resolution_m: f64,
    origin_m: [f64; 2],
    yaw_rad: f64,
    width: usize,
    height: usize,
    cells: Vec<Cell>,
}

impl OccupancyGrid {
    /// A grid of unknown cells of `resolution_m` metres with its lower left corner at `origin_m`
    /// (metres in `map`). A width or height of zero gives a single cell.
    pub fn new(
        resolution_m: f64,
        origin_m: [f64; 2],
        width: usize,
        height: usize,
    ) -> Result<Self, GridError> {
        if !(resolution_m.is_finite() && resolution_m > 0.0) {
            return Err(GridError::Resolution(resolution_m));
        }
        if !origin_m.iter().all(|coordinate| coordinate.is_finite()) {
            return Err(GridError::Origin(origin_m[0], origin_m[1], 0.0));
        }
        let (width, height) = if width == 0 || height == 0 { (1, 1) } else { (width, height) };
        let count = width
            .checked_mul(height)
            .filter(|count| *count <= MAX_CELLS)
            .ok_or(GridError::TooLarge { width: width as u64, height: height as u64 })?;
        let cells = vec![Cell::Unknown; count];
        Ok(Self { resolution_m, origin_m, yaw_rad: 0.0, width, height, cells })
    }

    /// The smallest grid that contains every known cell of the tiles, aligned with them; a single
    /// unknown cell at the origin if none is known.
    pub fn from_tiles<'a>(
        tiles: impl IntoIterator<Item = (TileId, &'a Tile)>,
        resolution: Millimetres,
    ) -> Result<Self, GridError> {
        let tiles: Vec<_> = tiles.into_iter().collect();
        let bounds = tiles.iter().filter_map(|(id, tile)| Bounds::of_tile(*id, tile));
        let bounds = bounds.reduce(Bounds::union).unwrap_or_default();

        let resolution_m = resolution.metres();
        let corner = |cell: i32| (i64::from(cell) * i64::from(resolution.0)) as f64 / 1000.0;
        let origin_m = [corner(bounds.west), corner(bounds.south)];
        let width = i64::from(bounds.east) - i64::from(bounds.west) + 1;
        let height = i64::from(bounds.north) - i64::from(bounds.south) + 1;
        let mut grid = Self::new(resolution_m, origin_m, width as usize, height as usize)?;

        for (id, tile) in tiles {
            let (first_x, first_y) = id.first_cell();
            for y in 0..TILE_SIDE {
                let mut known = tile.row(y).known();
                while known != 0 {
                    let x = known.trailing_zeros() as usize;
                    known &= known - 1;
                    let column = first_x + x as i32 - bounds.west;
                    let row = first_y + y as i32 - bounds.south;
                    grid.set(column as usize, row as usize, tile.cell(x, y));
                }
            }
        }
        Ok(grid)
    }

    /// Rotates the grid about its lower left corner to the given yaw in radians, counter-clockwise.
    pub fn with_yaw(mut self, yaw_rad: f64) -> Result<Self, GridError> {
        if !yaw_rad.is_finite() {
            return Err(GridError::Origin(self.origin_m[0], self.origin_m[1], yaw_rad));
        }
        self.yaw_rad = yaw_rad;
        Ok(self)
    }

    /// The side length of a cell in metres.
    pub fn resolution_m(&self) -> f64 {
        self.resolution_m
    }

    /// The lower left corner of the lower left cell: x and y in `map`, metres.
    pub fn origin_m(&self) -> [f64; 2] {
        self.origin_m
    }

    /// The rotation about the origin in radians, counter-clockwise.
    pub fn yaw_rad(&self) -> f64 {
        self.yaw_rad
    }

    /// Cells along x.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Cells along y.
    pub fn height(&self) -> usize {
        self.height
    }

    /// The cells, row by row from the south, each row from the west.
    pub fn cells(&self) -> &[Cell] {
        &self.cells
    }

    /// The cell at column `x` and row `y`; unknown outside of the grid.
    pub fn cell(&self, x: usize, y: usize) -> Cell {
        if x < self.width && y < self.height {
            self.cells[y * self.width + x]
        } else {
            Cell::Unknown
        }
    }

    /// Sets the cell at column `x` and row `y`; no effect outside of the grid.
    pub fn set(&mut self, x: usize, y: usize, cell: Cell) {
        if x < self.width && y < self.height {
            self.cells[y * self.width + x] = cell;
        }
    }

    /// Number of known, free and occupied cells.
    pub fn counts(&self) -> CellCounts {
        let mut counts = CellCounts::default();
        for cell in &self.cells {
            match cell {
                Cell::Unknown => {}
                Cell::Free => counts.free += 1,
                Cell::Occupied | Cell::Movable => counts.occupied += 1,
            }
        }
        counts.known = counts.free + counts.occupied;
        counts
    }

    /// Converts grid coordinates (in cells from the lower left corner) to `map` coordinates
    /// (metres). The centre of the cell at column 3 and row 0 is (3.5, 0.5).
    pub fn to_map(&self, point: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.yaw_rad.sin_cos();
        let [x, y] = point.map(|cells| cells * self.resolution_m);
        [self.origin_m[0] + x * cos - y * sin, self.origin_m[1] + x * sin + y * cos]
    }

    /// Converts `map` coordinates (metres) to grid coordinates (in cells from the lower left
    /// corner).
    pub fn from_map(&self, point: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.yaw_rad.sin_cos();
        let (x, y) = (point[0] - self.origin_m[0], point[1] - self.origin_m[1]);
        [(x * cos + y * sin) / self.resolution_m, (y * cos - x * sin) / self.resolution_m]
    }
}

/// Squares of other grids.
impl OccupancyGrid {
    /// The state of a square in `map` with this lower left corner and side, in metres: occupied if any cell
    /// of the grid in it is, otherwise unknown if any is, otherwise free. Points at most one cell apart are
    /// looked at, 64 along each side at most.
    pub fn square(&self, corner_m: [f64; 2], side_m: f64) -> Cell {
        let count = (side_m / self.resolution_m).ceil().clamp(1.0, 64.0) as u32;
        let part = |index: u32| side_m * (f64::from(index) + 0.5) / f64::from(count);
        let mut state = Cell::Free;
        for index in 0..count * count {
            let place = [corner_m[0] + part(index % count), corner_m[1] + part(index / count)];
            let [x, y] = self.from_map(place);
            let is_inside = x >= 0.0 && y >= 0.0;
            match if is_inside { self.cell(x as usize, y as usize) } else { Cell::Unknown } {
                Cell::Occupied | Cell::Movable => return Cell::Occupied,
                Cell::Unknown => state = Cell::Unknown,
                Cell::Free => {}
            }
        }
        state
    }

    /// A grid with the cells of another one, not rotated, and the state of ours in each of them.
    pub fn on_cells_of(&self, other: &Self) -> Self {
        let mut grid = other.clone();
        let side_m = other.resolution_m;
        for index in 0..other.cells.len() {
            let (x, y) = (index % other.width, index / other.width);
            let corner = other.to_map([x as f64, y as f64]);
            grid.set(x, y, self.square(corner, side_m));
        }
        grid
    }
}

/// Grid coordinates of the outermost known cells, inclusive.
#[derive(Clone, Copy, Default)]
struct Bounds {
    west: i32,
    south: i32,
    east: i32,
    north: i32,
}

impl Bounds {
    /// The bounds of a tile's known cells; `None` if there are none.
    fn of_tile(id: TileId, tile: &Tile) -> Option<Self> {
        let rows = || (0..TILE_SIDE).map(|y| tile.row(y).known());
        let columns = rows().fold(0, |columns, known| columns | known);
        if columns == 0 {
            return None;
        }
        let south = rows().position(|known| known != 0)? as i32;
        let north = (TILE_SIDE - 1 - rows().rev().position(|known| known != 0)?) as i32;
        let (x, y) = id.first_cell();
        Some(Self {
            west: x + columns.trailing_zeros() as i32,
            south: y + south,
            east: x + (31 - columns.leading_zeros()) as i32,
            north: y + north,
        })
    }

    fn union(self, other: Self) -> Self {
        Self {
            west: self.west.min(other.west),
            south: self.south.min(other.south),
            east: self.east.max(other.east),
            north: self.north.max(other.north),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_of_tiles_is_cropped_to_the_known_cells() {
        let mut west = Tile::UNKNOWN;
        west.set(31, 4, Cell::Free);
        let mut east = Tile::UNKNOWN;
        east.set(1, 6, Cell::Movable);
        east.set(0, 5, Cell::Occupied);
        let nothing = Tile::UNKNOWN;
        let tiles = [
            (TileId { x: -1, y: -1 }, &west),
            (TileId { x: 0, y: -1 }, &east),
            (TileId { x: 30_000, y: 30_000 }, &nothing),
        ];

        let grid = OccupancyGrid::from_tiles(tiles, Millimetres(50)).unwrap();
        assert_eq!((grid.width(), grid.height()), (3, 3));
        assert_eq!(grid.origin_m(), [-0.05, -1.4]);
        assert_eq!(grid.cell(0, 0), Cell::Free);
        assert_eq!(grid.cell(1, 1), Cell::Occupied);
        assert_eq!(grid.cell(2, 2), Cell::Movable);
        assert_eq!(grid.counts(), CellCounts { known: 3, free: 1, occupied: 2 });
    }

    #[test]
    fn no_tiles_give_one_unknown_cell() {
        let grid = OccupancyGrid::from_tiles([], Millimetres(50)).unwrap();
        assert_eq!((grid.width(), grid.height()), (1, 1));
        assert_eq!(grid.counts(), CellCounts::default());
    }

    #[test]
    fn tiles_too_far_apart_are_refused() {
        let mut tile = Tile::UNKNOWN;
        tile.set(0, 0, Cell::Free);
        let corners = [TileId { x: i16::MIN, y: i16::MIN }, TileId { x: i16::MAX, y: i16::MAX }];
        let grid = OccupancyGrid::from_tiles(corners.map(|id| (id, &tile)), Millimetres(50));
        assert!(matches!(grid, Err(GridError::TooLarge { width: 2_097_121, .. })));
    }

    #[test]
    fn coordinates_of_a_rotated_grid_survive_a_round_trip() {
        let grid = OccupancyGrid::new(0.1, [2.0, 3.0], 10, 10).unwrap();
        let grid = grid.with_yaw(std::f64::consts::FRAC_PI_2).unwrap();
        let [x, y] = grid.to_map([10.0, 0.0]);
        assert!((x - 2.0).abs() < 1e-9 && (y - 4.0).abs() < 1e-9);
        let [column, row] = grid.from_map([x, y]);
        assert!((column - 10.0).abs() < 1e-9 && row.abs() < 1e-9);
    }
}
