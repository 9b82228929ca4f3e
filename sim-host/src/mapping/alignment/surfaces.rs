//! The surfaces of the map, and of the robot's trail, by the direction from which they are visible.

use nalgebra::Vector2;
use ubimap_protocol::{
    tile::{Cell, TILE_SIDE, Tile, TileId, cell_of},
    units::{Millimetres, Pose},
};

use super::{
    geometry::{cell_at, line, position, quarter, rotated, square},
    trail::Trail,
};

/// Maximum distance, in cells, at which a point is matched with a surface of the map.
const REACH: i32 = 8;
/// Maximum distance, in cells, at which a point is matched with a surface of the trail.
const TRAIL_REACH: i32 = 4;
/// Distance from a surface of the map, in cells, within which surfaces of the trail are ignored.
const BESIDE: i32 = 2;
/// A line is fitted to the surface cells within this distance of a cell, in cells.
const LINE_REACH: i32 = 4;
/// Minimum number of surface cells for a line.
const LINE_CELLS: usize = 5;

/// A visible surface cell: occupied, next to a free one.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surface {
    /// A point on the surface's line, in millimetres in `map`.
    pub(super) middle: Vector2<f64>,
    /// Unit normal of the line; `None` if the cells near by form no line, as at the end of a
    /// surface or on a small object.
    pub(super) normal: Option<Vector2<f64>>,
}

/// The surface nearest to a cell.
#[derive(Clone, Copy, Debug)]
struct Nearest {
    /// Squared distance in cells.
    square: u16,
    surface: u32,
}

/// The surfaces visible in views towards one quadrant: a view to the north-east shows the western
/// and southern sides of objects. So a wall that is known from one side only does not match a view
/// of its other side, even if it is thin.
#[derive(Clone, Debug, Default)]
struct Facing {
    surfaces: Vec<Surface>,
    /// The nearest surface to each cell.
    nearest: Vec<Option<Nearest>>,
}

/// The surfaces of a section of the map.
#[derive(Clone, Debug)]
pub struct Surfaces {
    resolution: f64,
    /// The south-western cell.
    corner: (i32, i32),
    side: i32,
    codes: Vec<Cell>,
    /// Indexed by [`quarter`].
    facing: [Facing; 4],
}

impl Surfaces {
    /// The surfaces within `reach` of a pose along x and y. `tile` returns the tiles of the map;
    /// where they are unknown, the surfaces of `trail` are used. Cost: about a millisecond for 5 m
    /// of 5 cm cells.
    pub fn about(
        pose: Pose,
        reach: Millimetres,
        resolution: Millimetres,
        mut tile: impl FnMut(TileId) -> Tile,
        trail: &Trail,
    ) -> Self {
        let half = (reach.0 / resolution.0.max(1)).clamp(1, 1_000);
        let corner = (cell_of(pose.x, resolution) - half, cell_of(pose.y, resolution) - half);
        let side = 2 * half + 1;
        let mut all = Self {
            resolution: f64::from(resolution.0),
            corner,
            side,
            codes: vec![Cell::Unknown; (side * side) as usize],
            facing: Default::default(),
        };
        let step = TILE_SIDE as i32;
        let tiles = |from: i32| from.div_euclid(step)..=(from + side - 1).div_euclid(step);
        for (tile_x, tile_y) in
            tiles(corner.1).flat_map(|y| tiles(corner.0).map(move |x| (x * step, y * step)))
        {
            let Some(id) = TileId::of_cell(tile_x, tile_y) else { continue };
            let tile = tile(id);
            for (y, x) in (0..TILE_SIDE).flat_map(|y| (0..TILE_SIDE).map(move |x| (y, x))) {
                if let Some(index) = all.index((tile_x + x as i32, tile_y + y as i32)) {
                    all.codes[index] = tile.cell(x, y);
                }
            }
        }
        all.facing = core::array::from_fn(|quarter| all.facing(quarter, trail));
        all
    }

    fn index(&self, (x, y): (i32, i32)) -> Option<usize> {
        let (x, y) = (x.checked_sub(self.corner.0)?, y.checked_sub(self.corner.1)?);
        let within = (0..self.side).contains(&x) && (0..self.side).contains(&y);
        within.then_some((y * self.side + x) as usize)
    }

    pub(super) fn code(&self, cell: (i32, i32)) -> Cell {
        self.index(cell).map_or(Cell::Unknown, |index| self.codes[index])
    }

    pub(super) fn cell(&self, point: Vector2<f64>) -> (i32, i32) {
        cell_at(point, self.resolution)
    }

    /// The surfaces visible when looking into a quadrant.
    fn facing(&self, quarter: usize, trail: &Trail) -> Facing {
        let (west, south) = self.corner;
        // The direction from a cell towards its observer.
        let (aside, below) = (1 - 2 * (quarter as i32 & 1), 1 - 2 * (quarter as i32 >> 1));
        let cells =
            (south..south + self.side).flat_map(|y| (west..west + self.side).map(move |x| (x, y)));
        let cells: Vec<(i32, i32)> = cells
            .filter(|&(x, y)| {
                self.code((x, y)) == Cell::Occupied
                    && [(x + aside, y), (x, y + below)]
                        .into_iter()
                        .any(|beside| self.code(beside) == Cell::Free)
            })
            .collect();
        let mut is_surface = vec![false; self.codes.len()];
        for &cell in &cells {
            if let Some(index) = self.index(cell) {
                is_surface[index] = true;
            }
        }
        let mut facing = Facing { nearest: vec![None; self.codes.len()], surfaces: Vec::new() };
        for &(x, y) in &cells {
            let beside = square(LINE_REACH).map(|(dx, dy)| (x + dx, y + dy));
            let near: Vec<(i32, i32)> = beside
                .filter(|&cell| self.index(cell).is_some_and(|index| is_surface[index]))
                .collect();
            let found = self.surface((x, y), &near);
            if found.normal.is_none() && self.is_where_knowledge_ends((x, y)) {
                continue;
            }
            self.place(&mut facing, (x, y), found, REACH);
        }
        for ((x, y), middle, normal) in trail.seen(quarter) {
            let is_drawn =
                |(dx, dy)| self.index((x + dx, y + dy)).is_some_and(|index| is_surface[index]);
            if !square(BESIDE).any(is_drawn) {
                let seen = Surface { middle, normal: Some(normal) };
                self.place(&mut facing, (x, y), seen, TRAIL_REACH);
            }
        }
        facing
    }

    /// Adds the surface `it` at a cell, and makes it the nearest one of all cells within `reach`
    /// cells that have no closer one.
    fn place(&self, facing: &mut Facing, (x, y): (i32, i32), it: Surface, reach: i32) {
        let surface = facing.surfaces.len() as u32;
        facing.surfaces.push(it);
        for (dx, dy) in square(reach) {
            let square = (dx * dx + dy * dy) as u16;
            let Some(index) = self.index((x + dx, y + dy)) else { continue };
            let nearest = &mut facing.nearest[index];
            if i32::from(square) <= reach * reach && nearest.is_none_or(|it| square < it.square) {
                *nearest = Some(Nearest { square, surface });
            }
        }
    }

    /// Whether the surface at a cell may continue into unseen ground: the cell has an unknown
    /// neighbour next to a free cell. The end of such a surface does not constrain the position
    /// along it.
    fn is_where_knowledge_ends(&self, (x, y): (i32, i32)) -> bool {
        let is = |cell: (i32, i32), code| self.code(cell) == code;
        square(1).map(|(dx, dy)| (x + dx, y + dy)).any(|(x, y)| {
            is((x, y), Cell::Unknown)
                && [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)]
                    .into_iter()
                    .any(|cell| is(cell, Cell::Free))
        })
    }

    /// The surface at `cell`: a line fitted to the surface cells `near` it.
    fn surface(&self, cell: (i32, i32), near: &[(i32, i32)]) -> Surface {
        let middle = |(x, y): (i32, i32)| {
            Vector2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) * self.resolution
        };
        let near: Vec<Vector2<f64>> = near.iter().map(|&cell| middle(cell)).collect();
        match line(&near) {
            Some((middle, normal)) if near.len() >= LINE_CELLS => {
                Surface { middle, normal: Some(normal) }
            }
            _ => Surface { middle: middle(cell), normal: None },
        }
    }

    /// Returns two numbers of points, seen from `pose`: those within three cells of an occupied
    /// cell, and those on free ground with only free cells within three cells. Points near movable
    /// cells do not count.
    pub fn agreement(&self, points: &[[f64; 2]], pose: Pose) -> (u32, u32) {
        let at = position(pose);
        let (mut agree, mut contradict) = (0, 0);
        for &[x, y] in points {
            let seen = rotated(Vector2::new(x, y), pose.heading.radians()) + at;
            let cell = self.cell(seen);
            let near =
                |code| square(3).any(|(dx, dy)| self.code((cell.0 + dx, cell.1 + dy)) == code);
            if near(Cell::Movable) {
                continue;
            }
            if near(Cell::Occupied) {
                agree += 1;
            } else if self.code(cell) == Cell::Free && !near(Cell::Unknown) {
                contradict += 1;
            }
        }
        (agree, contradict)
    }

    /// The surface nearest to `point` among those visible when looking in the direction of `arm`.
    pub(super) fn seen_along(&self, arm: Vector2<f64>, point: Vector2<f64>) -> Option<&Surface> {
        let facing = &self.facing[quarter(arm)];
        let nearest = facing.nearest[self.index(self.cell(point))?]?;
        facing.surfaces.get(nearest.surface as usize)
    }

    /// Squared distance, in cells, from a cell to the nearest surface visible when looking into a
    /// quadrant.
    pub(super) fn nearest_square(&self, quarter: usize, cell: (i32, i32)) -> Option<i32> {
        self.facing[quarter].nearest[self.index(cell)?].map(|it| it.square.into())
    }

    /// The side length of a cell in millimetres.
    pub(super) fn resolution(&self) -> f64 {
        self.resolution
    }
}
