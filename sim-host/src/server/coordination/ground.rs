//! The ground for route planning: known and blind cells, and distances to walls.

use nalgebra::Point2;
use ubimap_protocol::tile::{Cell, TILE_SIDE, TileId};

use super::{drivable::DrivableFloor, settings::Settings};
use crate::mapping::ServedLayer;

/// A position in `map`, in metres.
pub(super) type Point = Point2<f64>;

/// A disc in `map`, in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Disc {
    pub(super) centre: Point,
    pub(super) radius: f64,
}

impl Disc {
    pub(super) fn grown(self, metres: f64) -> Self {
        Self { radius: self.radius + metres, ..self }
    }
}

/// The known part of the floor, as a rectangle of cells with a border of unknown ones. Cells are
/// indexed row by row from the south-west.
#[derive(Clone, Debug)]
pub(super) struct Ground {
    side_m: f64,
    /// Grid coordinates of the first cell.
    first: (i32, i32),
    width: usize,
    cells: Vec<Cell>,
    /// Whether the cell is unknown and out of view of the cameras.
    blind: Vec<bool>,
    /// Whether a camera sees the cell.
    covered: Vec<bool>,
    /// Whether the cell is known, or near a robot: a robot's own planner keeps its centre on known ground.
    trusted: Vec<bool>,
    /// Squared distances in cells, to the nearest wall (an occupied cell, or one deep in unknown
    /// ground) and to the nearest movable cell.
    walls: Vec<u32>,
    movable: Vec<u32>,
    /// Squared distances in cells to the floor that robots may use, and the greatest number in walls; empty if robots may
    /// use all of it.
    floor: Vec<u32>,
}

impl Ground {
    /// Builds the ground from the map and the coverage. Nothing in `trodden`, the discs that robots
    /// cover, is a wall, and unknown cells near them are passable; cells that `floor` does not allow are
    /// walls, whatever is there. `None` while no tile is known. Cost: 0.03 microseconds per cell.
    pub(super) fn survey(
        fused: &ServedLayer,
        coverage: &ServedLayer,
        trodden: &[Disc],
        floor: Option<&DrivableFloor>,
        settings: &Settings,
    ) -> Option<Self> {
        let side_m = settings.side_m();
        let extent = Extent::of(fused, middle(trodden, side_m), settings.survey.reach_tiles)?;
        let mut ground = Self::unknown(&extent, side_m);
        for id in extent.tiles() {
            ground.draw(id, fused, coverage);
        }
        if let Some(floor) = floor {
            ground.bar(&extent, floor);
        }
        ground.measure(trodden, settings);
        Some(ground)
    }

    /// Ground without known cells.
    fn unknown(extent: &Extent, side_m: f64) -> Self {
        let along = |from: i16, to: i16| (i32::from(to) - i32::from(from) + 1) as usize * TILE_SIDE;
        let width = along(extent.west, extent.east);
        let cells = width * along(extent.south, extent.north);
        Self {
            side_m,
            first: TileId { x: extent.west, y: extent.south }.first_cell(),
            width,
            cells: vec![Cell::Unknown; cells],
            blind: vec![true; cells],
            covered: vec![false; cells],
            trusted: Vec::new(),
            walls: Vec::new(),
            movable: Vec::new(),
            floor: Vec::new(),
        }
    }

    /// The index of the first cell of a tile.
    fn corner(&self, id: TileId) -> usize {
        let (x, y) = id.first_cell();
        (y - self.first.1) as usize * self.width + (x - self.first.0) as usize
    }

    /// Copies a tile of the map and of the coverage.
    fn draw(&mut self, id: TileId, fused: &ServedLayer, coverage: &ServedLayer) {
        let (known, covered) = (fused.get(id), coverage.get(id));
        if known.is_none() && covered.is_none() {
            return;
        }
        let corner = self.corner(id);
        for y in 0..TILE_SIDE {
            for x in 0..TILE_SIDE {
                let at = corner + y * self.width + x;
                let cell = known.map_or(Cell::Unknown, |(_, tile)| tile.cell(x, y));
                let is_covered = covered.is_some_and(|(_, it)| it.cell(x, y) == Cell::Free);
                self.cells[at] = cell;
                self.blind[at] = cell == Cell::Unknown && !is_covered;
                self.covered[at] = is_covered;
            }
        }
    }

    /// Bars the cells that robots may not use. Nothing is to be found there, so they are not blind.
    fn bar(&mut self, extent: &Extent, floor: &DrivableFloor) {
        let mut is_floor = vec![true; self.len()];
        for id in extent.tiles() {
            let corner = self.corner(id);
            for (y, open) in floor.rows(id).into_iter().enumerate() {
                for x in (0..TILE_SIDE).filter(|x| open >> x & 1 == 0) {
                    let at = corner + y * self.width + x;
                    (is_floor[at], self.blind[at]) = (false, false);
                }
            }
        }
        self.floor = squared_distances(&is_floor, self.width);
    }

    /// Computes the distances to walls and to movable cells. Unknown cells more than `edge_cells`
    /// from free ones count as walls.
    fn measure(&mut self, trodden: &[Disc], settings: &Settings) {
        let (clearances, edge_cells) = (settings.clearances, settings.survey.edge_cells);
        let is_free: Vec<bool> = self.cells.iter().map(|it| *it == Cell::Free).collect();
        let is_wall = |(cell, to_free)| match cell {
            Cell::Unknown => to_free > edge_cells * edge_cells,
            cell => cell == Cell::Occupied,
        };
        let to_free = squared_distances(&is_free, self.width);
        let mut is_wall: Vec<bool> = self.cells.iter().copied().zip(to_free).map(is_wall).collect();
        let mut trusted: Vec<bool> = self.cells.iter().map(|it| *it != Cell::Unknown).collect();
        for disc in trodden {
            let near = disc.grown(clearances.wall_m + clearances.trodden_m);
            self.within(&near, |at| {
                is_wall[at] &= self.cells[at] != Cell::Unknown;
                trusted[at] = true;
            });
            // Others have drawn its outline there while they did not know where it stands.
            self.within(&disc.grown(self.side_m), |at| is_wall[at] = false);
        }
        // The border stays impassable, so that searches need no bounds check.
        for (at, is_wall) in is_wall.iter_mut().enumerate() {
            *is_wall |= self.is_border(at);
        }
        for (is_wall, to_floor) in is_wall.iter_mut().zip(&mut self.floor) {
            match *is_wall {
                true => *to_floor = u32::MAX,
                false => *is_wall = *to_floor > 0,
            }
        }
        let is_movable: Vec<bool> = self.cells.iter().map(|it| *it == Cell::Movable).collect();
        self.trusted = trusted;
        self.walls = squared_distances(&is_wall, self.width);
        self.movable = squared_distances(&is_movable, self.width);
    }

    pub(super) fn len(&self) -> usize {
        self.cells.len()
    }

    /// Number of cells per row.
    pub(super) fn width(&self) -> usize {
        self.width
    }

    /// The side length of a cell in metres.
    pub(super) fn side_m(&self) -> f64 {
        self.side_m
    }

    pub(super) fn cell(&self, at: usize) -> Cell {
        self.cells[at]
    }

    pub(super) fn is_unknown(&self, at: usize) -> bool {
        self.cells[at] == Cell::Unknown
    }

    /// Whether a robot's own planner lets its centre be there, as far as walls allow it.
    pub(super) fn is_trusted(&self, at: usize) -> bool {
        self.trusted[at]
    }

    /// Whether the cell is unknown and out of view of the cameras.
    pub(super) fn is_blind(&self, at: usize) -> bool {
        self.blind[at]
    }

    /// Whether a camera sees the cell.
    pub(super) fn is_covered(&self, at: usize) -> bool {
        self.covered[at]
    }

    /// Whether cameras see nearly all of a disc; what stands on it hides some cells.
    pub(super) fn is_in_view(&self, disc: &Disc) -> bool {
        let (mut seen, mut all) = (0, 0);
        self.within(disc, |at| {
            seen += usize::from(self.covered[at]);
            all += 1;
        });
        all > 0 && 4 * seen >= 3 * all
    }

    /// Whether a camera sees any cell of a disc.
    pub(super) fn is_partly_in_view(&self, disc: &Disc) -> bool {
        let mut is_seen = false;
        self.within(disc, |at| is_seen |= self.covered[at]);
        is_seen
    }

    /// Squared distance, in cells, to the nearest wall or cell deep in unknown ground.
    pub(super) fn to_wall(&self, at: usize) -> u32 {
        self.walls[at]
    }

    /// Squared distance, in cells, to the floor that robots may use; the greatest number in a wall.
    pub(super) fn to_floor(&self, at: usize) -> u32 {
        self.floor.get(at).copied().unwrap_or(0)
    }

    /// Squared distance, in cells, to the nearest movable cell.
    pub(super) fn to_movable(&self, at: usize) -> u32 {
        self.movable[at]
    }

    /// Whether the nearest wall or cell deep in unknown ground is at least `metres` away.
    pub(super) fn has_room(&self, place: Point, metres: f64) -> bool {
        let cells = metres / self.side_m;
        self.at(place).is_some_and(|at| f64::from(self.walls[at]) >= cells * cells)
    }

    /// The index of the cell that contains a position; `None` on the border and outside.
    pub(super) fn at(&self, place: Point) -> Option<usize> {
        let column = (place.x / self.side_m).floor() - f64::from(self.first.0);
        let row = (place.y / self.side_m).floor() - f64::from(self.first.1);
        if !(column >= 1.0 && row >= 1.0) {
            return None;
        }
        // The casts saturate.
        let (column, row) = (column as usize, row as usize);
        let inside = column < self.width - 1 && row < self.len() / self.width - 1;
        inside.then(|| row * self.width + column)
    }

    /// The centre of a cell.
    pub(super) fn place(&self, at: usize) -> Point {
        let (column, row) = (at % self.width, at / self.width);
        let along =
            |first: i32, cells: usize| (f64::from(first) + cells as f64 + 0.5) * self.side_m;
        Point::new(along(self.first.0, column), along(self.first.1, row))
    }

    /// Calls `each` for every cell whose centre lies in a disc.
    pub(super) fn within(&self, disc: &Disc, mut each: impl FnMut(usize)) {
        let rows = self.len() / self.width;
        let span = |centre: f64, first: i32, end: usize| {
            let from = ((centre - disc.radius) / self.side_m).floor() - f64::from(first);
            let to = ((centre + disc.radius) / self.side_m).ceil() - f64::from(first);
            // The casts saturate.
            (from as usize).min(end)..(to as usize).min(end)
        };
        let columns = span(disc.centre.x, self.first.0, self.width);
        for row in span(disc.centre.y, self.first.1, rows) {
            for column in columns.clone() {
                let at = row * self.width + column;
                let off = self.place(at) - disc.centre;
                if off.norm_squared() <= disc.radius * disc.radius {
                    each(at);
                }
            }
        }
    }

    fn is_border(&self, at: usize) -> bool {
        let (column, row) = (at % self.width, at / self.width);
        column == 0 || row == 0 || column == self.width - 1 || row == self.len() / self.width - 1
    }
}

/// The rectangle of surveyed tiles.
struct Extent {
    west: i16,
    east: i16,
    south: i16,
    north: i16,
}

impl Extent {
    /// The rectangle around the known tiles that are within `reach` tiles of `middle`, plus one
    /// tile on each side, where robots may stand to look at them. `None` if no tile is known.
    fn of(fused: &ServedLayer, middle: (i32, i32), reach: i32) -> Option<Self> {
        let near = |id: &TileId| {
            (i32::from(id.x) - middle.0).abs() <= reach
                && (i32::from(id.y) - middle.1).abs() <= reach
        };
        let tiles = || fused.tiles().map(|(id, ..)| id).filter(near);
        Some(Self {
            west: tiles().map(|id| id.x).min()?.saturating_sub(1),
            east: tiles().map(|id| id.x).max()?.saturating_add(1),
            south: tiles().map(|id| id.y).min()?.saturating_sub(1),
            north: tiles().map(|id| id.y).max()?.saturating_add(1),
        })
    }

    fn tiles(&self) -> impl Iterator<Item = TileId> + use<> {
        let columns = self.west..=self.east;
        (self.south..=self.north).flat_map(move |y| columns.clone().map(move |x| TileId { x, y }))
    }
}

/// The tile at the median of the robots' positions; the mean would follow a robot that reports an
/// absurd pose.
fn middle(trodden: &[Disc], side_m: f64) -> (i32, i32) {
    let tile_m = side_m * TILE_SIDE as f64;
    let median = |along: fn(&Disc) -> f64| {
        let mut all: Vec<f64> = trodden.iter().map(along).collect();
        all.sort_by(f64::total_cmp);
        all.get(all.len() / 2).map_or(0, |metres| (metres / tile_m).floor() as i32)
    };
    (median(|disc| disc.centre.x), median(|disc| disc.centre.y))
}

/// The exact squared distance from each cell to the nearest marked one, by the two passes of
/// Meijster, Roerdink and Hesselink ("A general algorithm for computing distance transforms in
/// linear time", 2000). Larger than the grid if nothing is marked.
fn squared_distances(marked: &[bool], width: usize) -> Vec<u32> {
    let height = marked.len() / width;
    let far = (width + height) as i64;
    let mut along_y = vec![far; marked.len()];
    for at in 0..marked.len() {
        let south = at.checked_sub(width).map_or(far, |south| along_y[south]);
        along_y[at] = if marked[at] { 0 } else { (south + 1).min(far) };
    }
    for at in (0..marked.len().saturating_sub(width)).rev() {
        along_y[at] = along_y[at].min(along_y[at + width] + 1);
    }
    let mut squared = vec![0; marked.len()];
    // The lower envelope of the parabolas of a row: the column of each parabola, and the first
    // column in which it is the lowest.
    let mut lowest: Vec<(i64, i64)> = Vec::with_capacity(width);
    for (row, out) in along_y.chunks(width).zip(squared.chunks_mut(width)) {
        let height_at = |x: i64, column: i64| {
            let up = row[column as usize];
            (x - column) * (x - column) + up * up
        };
        lowest.clear();
        for column in 0..width as i64 {
            while lowest
                .last()
                .is_some_and(|&(it, from)| height_at(from, it) > height_at(from, column))
            {
                lowest.pop();
            }
            let from = lowest.last().map_or(0, |&(it, _)| {
                let rise = height_at(0, column) - height_at(0, it);
                1 + rise.div_euclid(2 * (column - it))
            });
            if from < width as i64 {
                lowest.push((column, from));
            }
        }
        for x in (0..width as i64).rev() {
            while lowest.len() > 1 && lowest.last().is_some_and(|&(_, from)| from > x) {
                lowest.pop();
            }
            let nearest = lowest.last().map_or(far * far, |&(column, _)| height_at(x, column));
            out[x as usize] = u32::try_from(nearest).unwrap_or(u32::MAX);
        }
    }
    squared
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use ubimap_protocol::tile::{TILE_CELLS, Tile};

    fn layer(cell: impl Fn(i32, i32) -> Cell) -> ServedLayer {
        let mut layer = ServedLayer::default();
        for (x, y) in [(-1, 0), (0, 0)] {
            let id = TileId { x, y };
            let mut tile = Tile::UNKNOWN;
            let (west, south) = id.first_cell();
            for at in 0..TILE_SIDE * TILE_SIDE {
                let (x, y) = (at % TILE_SIDE, at / TILE_SIDE);
                tile.set(x, y, cell(west + x as i32, south + y as i32));
            }
            layer.set(id, tile);
        }
        layer
    }

    #[test]
    fn positions_and_cells_agree() {
        let fused = layer(|x, y| if x == y { Cell::Occupied } else { Cell::Free });
        let ground = Ground::survey(&fused, &fused, &[], None, &Settings::default()).unwrap();
        for (x, y) in [(-32, 0), (31, 31), (0, 0), (-1, 7)] {
            let place = Point::new((f64::from(x) + 0.5) * 0.05, (f64::from(y) + 0.5) * 0.05);
            let at = ground.at(place).unwrap();
            assert!((ground.place(at) - place).norm() < 1e-9);
            assert_eq!(ground.cell(at) == Cell::Occupied, x == y);
        }
        for outside in [(-3.2, 0.1), (3.2, 0.1), (0.1, -1.6), (0.1, 3.2), (f64::NAN, 0.0)] {
            assert_eq!(ground.at(Point::new(outside.0, outside.1)), None, "{outside:?}");
        }
    }

    #[test]
    fn unknown_ground_is_blind_out_of_view_and_passable_below_robots() {
        let fused = layer(|x, _| if x < 0 { Cell::Free } else { Cell::Unknown });
        let coverage = layer(|_, y| if y < 8 { Cell::Free } else { Cell::Unknown });
        let robot = Disc { centre: Point::new(0.5, 0.8), radius: 0.2 };
        let ground =
            Ground::survey(&fused, &coverage, &[robot], None, &Settings::default()).unwrap();
        let at = |x, y| ground.at(Point::new(x, y)).unwrap();
        assert!(ground.is_blind(at(0.5, 0.8)) && !ground.is_blind(at(0.5, 0.2)));
        assert!(!ground.is_blind(at(-0.5, 0.8)));
        assert!(ground.to_wall(at(0.5, 0.8)) >= 9 && ground.to_wall(at(0.5, 0.1)) == 0);
    }

    #[test]
    fn its_own_outline_does_not_shut_a_robot_in() {
        let robot = Disc { centre: Point::new(-0.5, 0.8), radius: 0.2 };
        let fused = layer(|x, y| {
            let off = Point::new(f64::from(x) + 0.5, f64::from(y) + 0.5) * 0.05 - robot.centre;
            match (off.norm() - robot.radius).abs() < 0.05 || y == 4 {
                true => Cell::Occupied,
                false => Cell::Free,
            }
        });
        let walls = |trodden: &[Disc]| {
            let ground = Ground::survey(&fused, &fused, trodden, None, &Settings::default());
            let ground = ground.unwrap();
            let to_wall = |x, y| ground.to_wall(ground.at(Point::new(x, y)).unwrap());
            (to_wall(-0.5, 0.8), to_wall(-0.5, 0.22))
        };
        assert!(walls(&[]).0 <= 25 && walls(&[]).1 == 0);
        // The next wall is the one in the south.
        assert_eq!(walls(&[robot]), (12 * 12, 0));
    }

    #[test]
    fn a_stray_tile_costs_no_memory() {
        let mut fused = layer(|_, _| Cell::Free);
        let mut tile = Tile::UNKNOWN;
        tile.set(0, 0, Cell::Free);
        fused.set(TileId { x: i16::MAX, y: i16::MIN }, tile);
        let ground = Ground::survey(&fused, &fused, &[], None, &Settings::default()).unwrap();
        assert_eq!(ground.len(), 4 * 3 * usize::from(TILE_CELLS));
    }

    proptest! {
        /// The oracle computes the distances between all pairs of cells.
        #[test]
        fn distances_are_exact(
            width in 1usize..14,
            cells in proptest::collection::vec(proptest::bool::weighted(0.1), 1..150),
        ) {
            let marked = &cells[..cells.len() / width * width];
            let distances = squared_distances(marked, width);
            for (at, &distance) in distances.iter().enumerate() {
                let to = |other: usize| {
                    let along = |a: usize, b: usize| (a.abs_diff(b) * a.abs_diff(b)) as u32;
                    along(at % width, other % width) + along(at / width, other / width)
                };
                let expected = (0..marked.len()).filter(|&it| marked[it]).map(to).min();
                match expected {
                    Some(expected) => prop_assert_eq!(distance, expected),
                    None => prop_assert!(distance as usize >= width * width),
                }
            }
        }
    }
}
