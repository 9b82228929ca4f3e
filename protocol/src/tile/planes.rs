//! A tile of the map as bit planes: one `u32` word is one row of one plane.

use serde::{Deserialize, Serialize};

use crate::units::Millimetres;

/// Cells along one side of a tile, and bits in a word of a plane.
pub const TILE_SIDE: usize = 32;

/// The published state of one cell.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Cell {
    /// Never observed.
    #[default]
    Unknown = 0,
    /// Nothing is there.
    Free = 1,
    /// A fixed object is there.
    Occupied = 2,
    /// An object that is likely to move again is there (Aluckal: "extended awareness").
    Movable = 3,
}

impl Cell {
    /// The cell with a two-bit code; higher bits are ignored.
    pub const fn from_code(code: u8) -> Self {
        match code & 3 {
            0 => Self::Unknown,
            1 => Self::Free,
            2 => Self::Occupied,
            _ => Self::Movable,
        }
    }

    /// The cell's two-bit code.
    pub const fn code(self) -> u8 {
        self as u8
    }
}

/// The position of a tile in the grid of tiles, in the frame `map`. The lower left corner of tile
/// (0, 0) is at the origin.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct TileId {
    /// Column, growing along `map`'s x (east).
    pub x: i16,
    /// Row, growing along `map`'s y (north).
    pub y: i16,
}

impl TileId {
    /// The tile that holds the cell with these grid coordinates (in cells from the origin of
    /// `map`), or `None` beyond the grid (32,768 tiles from the origin).
    pub fn of_cell(x: i32, y: i32) -> Option<Self> {
        let side = TILE_SIDE as i32;
        Some(Self {
            x: i16::try_from(x.div_euclid(side)).ok()?,
            y: i16::try_from(y.div_euclid(side)).ok()?,
        })
    }

    /// The grid coordinates of the tile's lower left cell.
    pub fn first_cell(self) -> (i32, i32) {
        let side = TILE_SIDE as i32;
        (i32::from(self.x) * side, i32::from(self.y) * side)
    }
}

/// The grid coordinate of the cell that contains `coordinate`; cells have sides of `resolution`.
pub fn cell_of(coordinate: Millimetres, resolution: Millimetres) -> i32 {
    coordinate.0.div_euclid(resolution.0.max(1))
}

/// The map that a tile belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[repr(u8)]
pub enum Layer {
    /// The map of one robot, written by that robot only.
    Robot = 0,
    /// The cells that the cameras see now, written by the server only.
    Coverage = 1,
    /// The common map of all robots and cameras, written by the server only.
    Fused = 2,
}

/// 32 x 32 cells in two planes (256 bytes). Bit `x` of row `y` is the cell at column `x` from the
/// west and row `y` from the south.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    /// Bit 0 of every cell's code.
    pub low: [u32; TILE_SIDE],
    /// Bit 1 of every cell's code.
    pub high: [u32; TILE_SIDE],
}

impl Default for Tile {
    fn default() -> Self {
        Self::UNKNOWN
    }
}

impl Tile {
    /// A tile with all cells unknown.
    pub const UNKNOWN: Self = Self { low: [0; TILE_SIDE], high: [0; TILE_SIDE] };

    /// The cell at column `x` and row `y`; both are taken modulo 32.
    pub fn cell(&self, x: usize, y: usize) -> Cell {
        let (x, y) = (x % TILE_SIDE, y % TILE_SIDE);
        let low = (self.low[y] >> x) & 1;
        let high = (self.high[y] >> x) & 1;
        Cell::from_code((high << 1 | low) as u8)
    }

    /// Sets the cell at column `x` and row `y`; both are taken modulo 32.
    pub fn set(&mut self, x: usize, y: usize, cell: Cell) {
        let (x, y) = (x % TILE_SIDE, y % TILE_SIDE);
        let code = u32::from(cell.code());
        self.low[y] = self.low[y] & !(1 << x) | (code & 1) << x;
        self.high[y] = self.high[y] & !(1 << x) | (code >> 1) << x;
    }

    /// Row `y` modulo 32.
    pub fn row(&self, y: usize) -> Row {
        let y = y % TILE_SIDE;
        Row { low: self.low[y], high: self.high[y] }
    }

    /// Replaces row `y` modulo 32.
    pub fn set_row(&mut self, y: usize, row: Row) {
        let y = y % TILE_SIDE;
        self.low[y] = row.low;
        self.high[y] = row.high;
    }

    /// The numbers of cells that are known, free, and occupied (fixed or movable).
    pub fn counts(&self) -> (u32, u32, u32) {
        let mut known = 0;
        let mut occupied = 0;
        for row in 0..TILE_SIDE {
            known += (self.low[row] | self.high[row]).count_ones();
            occupied += self.high[row].count_ones();
        }
        (known, known - occupied, occupied)
    }

    /// Fills the unknown cells from `older`, an older state of the same tile.
    pub fn fill_unknown_from(&mut self, older: &Self) {
        for row in 0..TILE_SIDE {
            let unknown = !(self.low[row] | self.high[row]);
            self.low[row] |= older.low[row] & unknown;
            self.high[row] |= older.high[row] & unknown;
        }
    }
}

/// One row of a tile: 32 cells, the westernmost in bit 0.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Row {
    /// Bit 0 of the codes.
    pub low: u32,
    /// Bit 1 of the codes.
    pub high: u32,
}

impl Row {
    /// The cells that are known, as a mask.
    pub fn known(self) -> u32 {
        self.low | self.high
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_reads_back_what_was_set() {
        let mut tile = Tile::UNKNOWN;
        tile.set(31, 0, Cell::Movable);
        tile.set(0, 31, Cell::Free);
        tile.set(5, 6, Cell::Occupied);
        tile.set(5, 6, Cell::Free);
        assert_eq!(tile.cell(31, 0), Cell::Movable);
        assert_eq!(tile.cell(0, 31), Cell::Free);
        assert_eq!(tile.cell(5, 6), Cell::Free);
        assert_eq!(tile.counts(), (3, 2, 1));
    }

    #[test]
    fn negative_cells_are_in_the_tile_below_the_origin() {
        assert_eq!(TileId::of_cell(-1, -32), Some(TileId { x: -1, y: -1 }));
        assert_eq!(TileId::of_cell(-33, 31), Some(TileId { x: -2, y: 0 }));
        assert_eq!(TileId::of_cell(i32::MAX, 0), None);
        let cell = |coordinate| cell_of(Millimetres(coordinate), Millimetres(50));
        assert_eq!([-51, -50, -1, 0, 49, 50].map(cell), [-2, -1, -1, 0, 0, 1]);
    }

    #[test]
    fn the_first_cell_of_a_tile_is_its_lower_left_one() {
        assert_eq!(TileId { x: -2, y: 3 }.first_cell(), (-64, 96));
        for id in [TileId { x: -32_768, y: 32_767 }, TileId { x: 5, y: 0 }] {
            let (x, y) = id.first_cell();
            assert_eq!(TileId::of_cell(x, y), Some(id));
            assert_ne!(TileId::of_cell(x - 1, y), Some(id));
            assert_ne!(TileId::of_cell(x, y - 1), Some(id));
        }
    }

    #[test]
    fn filling_keeps_the_cells_that_are_known() {
        let mut newer = Tile::UNKNOWN;
        newer.set(1, 1, Cell::Free);
        let mut older = Tile::UNKNOWN;
        older.set(1, 1, Cell::Occupied);
        older.set(2, 2, Cell::Movable);
        newer.fill_unknown_from(&older);
        assert_eq!(newer.cell(1, 1), Cell::Free);
        assert_eq!(newer.cell(2, 2), Cell::Movable);
        assert_eq!(newer.counts(), (2, 1, 1));
    }
}
