//! The room to be covered: its floor, divided into cells, and the obstacles in it.

use ubimap_protocol::tile::Cell;

use super::obstacle::Obstacle;
use crate::grid::OccupancyGrid;

/// Maximum number of cells of a room's lattice, for example 500 x 500 m at 0.5 m.
const MOST_CELLS: f64 = 1e6;

/// Maximum number of sample points along a side of a cell; they decide whether the cell is floor.
const MOST_SAMPLES: usize = 20;

/// Distance between sample points in rooms that are not read from a map, in metres.
const SAMPLE_M: f64 = 0.05;

/// Minimum number of connected floor cells. Smaller pieces, such as specks of a recorded map, are
/// left out.
const LEAST_PIECE: usize = 4;

/// The boundary of a room's floor.
#[derive(Clone, Debug)]
pub enum Enclosure {
    /// A polygon given by its corners, in metres.
    Outline(Vec<[f64; 2]>),
    /// A map without yaw: its free cells are floor; its occupied cells are walls up to the ceiling.
    Map(OccupancyGrid),
}

/// Why a room has no floor plan. The messages do not name the room.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum FloorPlanError {
    /// No cell is floor.
    #[error("has no floor: no cell of {side_m} m is free on at least half of its area")]
    NoFloor {
        /// Side of a cell, in metres.
        side_m: f64,
    },
    /// The room has too many cells.
    #[error("has {columns} x {rows} cells of {side_m} m; use larger cells (at most {MOST_CELLS})")]
    TooLarge {
        /// Side of a cell, in metres.
        side_m: f64,
        /// Cells along x.
        columns: f64,
        /// Cells along y.
        rows: f64,
    },
}

/// A cell of the floor: an `s_j` of the paper's `S`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FloorCell {
    /// Column of the lattice, from zero in the west.
    pub column: usize,
    /// Row of the lattice, from zero in the south.
    pub row: usize,
    /// The floor point nearest to the cell's centre, in `map`, metres. A camera covers the cell if it
    /// sees this point.
    pub aim_m: [f64; 2],
}

/// The floor of a room as a lattice of square cells, and what can hide it from a camera.
///
/// The lattice is aligned with `map`'s origin: corners lie at multiples of the side.
#[derive(Clone, Debug)]
pub struct FloorPlan {
    enclosure: Enclosure,
    obstacles: Vec<Obstacle>,
    ceiling_m: f64,
    side_m: f64,
    origin_m: [f64; 2],
    columns: usize,
    rows: usize,
    cells: Vec<FloorCell>,
    /// For each square of the lattice, the index of its cell plus one; zero if the square is not
    /// floor.
    index: Vec<u32>,
    left_out: usize,
}

impl FloorPlan {
    /// The plan of a room, in cells with a side of `side_m` metres.
    ///
    /// A cell is floor if at least half of its area is inside the enclosure and free of obstacles
    /// lower than `robot_height_m`. Pieces of fewer than four cells are left out.
    ///
    /// # Errors
    /// Every [`FloorPlanError`].
    pub fn new(
        enclosure: Enclosure,
        obstacles: Vec<Obstacle>,
        [ceiling_m, robot_height_m]: [f64; 2],
        side_m: f64,
    ) -> Result<Self, FloorPlanError> {
        let [low, high] = enclosure.bounds();
        // A corner within a micrometre of a multiple of the side is taken as that multiple.
        let first = low.map(|it| (it / side_m + 1e-6).floor());
        let last = high.map(|it| (it / side_m - 1e-6).ceil());
        let size = [last[0] - first[0], last[1] - first[1]];
        if size[0] * size[1] > MOST_CELLS {
            return Err(FloorPlanError::TooLarge { side_m, columns: size[0], rows: size[1] });
        }
        let [columns, rows] = size.map(|it| it.max(0.0) as usize);
        let mut plan = Self {
            enclosure,
            obstacles,
            ceiling_m,
            side_m,
            origin_m: first.map(|it| it * side_m),
            columns,
            rows,
            cells: Vec::new(),
            index: vec![0; columns * rows],
            left_out: 0,
        };
        plan.find_floor(robot_height_m);
        plan.leave_out_speckles();
        if plan.cells.is_empty() {
            return Err(FloorPlanError::NoFloor { side_m });
        }
        Ok(plan)
    }

    /// The cells of the floor, row by row from the south-west.
    pub fn cells(&self) -> &[FloorCell] {
        &self.cells
    }

    /// Side of a cell, in metres.
    pub fn side_m(&self) -> f64 {
        self.side_m
    }

    /// South-western corner of the lattice in `map`, in metres.
    pub fn origin_m(&self) -> [f64; 2] {
        self.origin_m
    }

    /// Columns and rows of the lattice.
    pub fn size(&self) -> [usize; 2] {
        [self.columns, self.rows]
    }

    /// Height of the ceiling in metres; infinite for a map.
    pub fn ceiling_m(&self) -> f64 {
        self.ceiling_m
    }

    /// The obstacles in the room, apart from the walls of a map.
    pub fn obstacles(&self) -> &[Obstacle] {
        &self.obstacles
    }

    /// The boundary of the floor.
    pub fn enclosure(&self) -> &Enclosure {
        &self.enclosure
    }

    /// Number of floor cells left out because their piece is too small.
    pub fn left_out(&self) -> usize {
        self.left_out
    }

    /// The index of the cell at a column and a row, if it is floor.
    pub fn cell_at(&self, column: usize, row: usize) -> Option<usize> {
        if column >= self.columns || row >= self.rows {
            return None;
        }
        (self.index[row * self.columns + column] as usize).checked_sub(1)
    }

    /// The cells whose squares meet a rectangle, given by its corners in metres.
    pub fn cells_within(&self, low_m: [f64; 2], high_m: [f64; 2]) -> impl Iterator<Item = usize> {
        let place = |at: f64, axis: usize| {
            // The cast saturates: negative coordinates become zero.
            ((at - self.origin_m[axis]) / self.side_m).max(0.0) as usize
        };
        let columns = place(low_m[0], 0)..(place(high_m[0], 0) + 1).min(self.columns);
        let rows = place(low_m[1], 1)..(place(high_m[1], 1) + 1).min(self.rows);
        rows.flat_map(move |row| columns.clone().filter_map(move |it| self.cell_at(it, row)))
    }

    /// Whether a camera can hang at a point of `map` at this height in metres: inside the room, and
    /// outside of every obstacle.
    pub fn can_hold_camera(&self, point_m: [f64; 2], height_m: f64) -> bool {
        self.enclosure.is_inside(point_m)
            && height_m <= self.ceiling_m
            && !self.obstacles.iter().any(|it| it.spans(height_m) && it.contains(point_m))
    }

    /// The points of `map` at which cameras can hang at a height in metres: in each square with a
    /// side of `spacing_m`, the possible point nearest to its centre, if there is one.
    pub fn mounts(&self, spacing_m: f64, height_m: f64) -> Vec<[f64; 2]> {
        let [low, high] = [
            self.origin_m,
            [0, 1].map(|axis| self.origin_m[axis] + self.size()[axis] as f64 * self.side_m),
        ];
        let first = low.map(|it| (it / spacing_m + 1e-6).floor() as i64);
        let last = high.map(|it| (it / spacing_m - 1e-6).ceil() as i64);
        let offsets = self.offsets(spacing_m);
        let mut mounts = Vec::new();
        for row in first[1]..last[1] {
            for column in first[0]..last[0] {
                let corner = [column as f64 * spacing_m, row as f64 * spacing_m];
                let mut points = offsets.iter().map(|it| [corner[0] + it[0], corner[1] + it[1]]);
                mounts.extend(points.find(|&point| self.can_hold_camera(point, height_m)));
            }
        }
        mounts
    }

    fn find_floor(&mut self, robot_height_m: f64) {
        let offsets = self.offsets(self.side_m);
        let low: Vec<&Obstacle> =
            self.obstacles.iter().filter(|it| it.bottom_m < robot_height_m).collect();
        let is_floor = |point: &[f64; 2]| {
            self.enclosure.is_inside(*point) && !low.iter().any(|it| it.contains(*point))
        };
        let mut cells = Vec::new();
        for row in 0..self.rows {
            for column in 0..self.columns {
                let corner = [
                    self.origin_m[0] + column as f64 * self.side_m,
                    self.origin_m[1] + row as f64 * self.side_m,
                ];
                let points = offsets.iter().map(|it| [corner[0] + it[0], corner[1] + it[1]]);
                let mut floor = points.filter(is_floor);
                let Some(aim_m) = floor.next() else { continue };
                if 2 * (1 + floor.count()) >= offsets.len() {
                    cells.push(FloorCell { column, row, aim_m });
                }
            }
        }
        self.keep(cells);
    }

    /// Sets the cells of the floor.
    fn keep(&mut self, cells: Vec<FloorCell>) {
        self.index.fill(0);
        for (number, cell) in (1..).zip(&cells) {
            self.index[cell.row * self.columns + cell.column] = number;
        }
        self.cells = cells;
    }

    fn leave_out_speckles(&mut self) {
        let mut piece_of = vec![usize::MAX; self.cells.len()];
        let mut sizes = Vec::new();
        for start in 0..self.cells.len() {
            if piece_of[start] != usize::MAX {
                continue;
            }
            let piece = sizes.len();
            piece_of[start] = piece;
            let (mut waiting, mut size) = (vec![start], 0);
            while let Some(cell) = waiting.pop() {
                size += 1;
                let FloorCell { column, row, .. } = self.cells[cell];
                let beside = [
                    (column + 1, row),
                    (column.wrapping_sub(1), row),
                    (column, row + 1),
                    (column, row.wrapping_sub(1)),
                ];
                for next in beside.into_iter().filter_map(|(column, row)| self.cell_at(column, row))
                {
                    if piece_of[next] == usize::MAX {
                        piece_of[next] = piece;
                        waiting.push(next);
                    }
                }
            }
            sizes.push(size);
        }
        let counts = |cell: usize| sizes[piece_of[cell]] >= LEAST_PIECE;
        let kept: Vec<FloorCell> = (0..self.cells.len())
            .filter(|&cell| counts(cell))
            .map(|cell| self.cells[cell])
            .collect();
        // A room that consists only of small pieces keeps them.
        if !kept.is_empty() {
            self.left_out = self.cells.len() - kept.len();
            self.keep(kept);
        }
    }

    /// The sample points of a square with this side, in metres from its corner, nearest to the
    /// centre first. Their number along each side is odd.
    fn offsets(&self, side_m: f64) -> Vec<[f64; 2]> {
        let pitch = match &self.enclosure {
            Enclosure::Outline(_) => SAMPLE_M,
            Enclosure::Map(map) => map.resolution_m(),
        };
        let samples = ((side_m / pitch).round() as usize).clamp(1, MOST_SAMPLES) | 1;
        let offset = |index: usize| (index as f64 + 0.5) / samples as f64 * side_m;
        let mut offsets: Vec<[f64; 2]> = (0..samples * samples)
            .map(|index| [offset(index % samples), offset(index / samples)])
            .collect();
        offsets.sort_by(|a, b| {
            let [a, b] = [a, b].map(|[x, y]| (x - side_m / 2.0).hypot(y - side_m / 2.0));
            a.total_cmp(&b)
        });
        offsets
    }
}

impl Enclosure {
    /// Whether a point of `map` is inside the outline, or free on the map.
    fn is_inside(&self, point: [f64; 2]) -> bool {
        match self {
            Self::Outline(outline) => is_in_polygon(outline, point),
            Self::Map(map) => {
                let [x, y] = map.from_map(point);
                x >= 0.0 && y >= 0.0 && map.cell(x as usize, y as usize) == Cell::Free
            }
        }
    }

    /// The minimum and maximum coordinates, in metres.
    fn bounds(&self) -> [[f64; 2]; 2] {
        match self {
            Self::Outline(outline) => {
                let bound = |axis: usize, of: fn(f64, f64) -> f64| {
                    outline.iter().map(|corner| corner[axis]).reduce(of).unwrap_or(0.0)
                };
                [[bound(0, f64::min), bound(1, f64::min)], [bound(0, f64::max), bound(1, f64::max)]]
            }
            Self::Map(map) => {
                [map.origin_m(), map.to_map([map.width() as f64, map.height() as f64])]
            }
        }
    }
}

/// Whether a point is inside a polygon: a ray to the right crosses its edges an odd number of
/// times.
fn is_in_polygon(corners: &[[f64; 2]], [x, y]: [f64; 2]) -> bool {
    let next = corners.iter().cycle().skip(1);
    let crosses = corners.iter().zip(next).filter(|(from, to)| {
        (from[1] > y) != (to[1] > y)
            && x < from[0] + (y - from[1]) / (to[1] - from[1]) * (to[0] - from[0])
    });
    crosses.count() % 2 == 1
}
