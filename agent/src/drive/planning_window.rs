//! The ground around the robot as bit planes: where its centre may be, which cells are costly, and
//! where unmapped blind ground begins.

use ubimap_protocol::{
    message::Waypoint,
    tile::{Row, TILE_SIDE},
    units::{Millimetres, Pose},
};

use super::{
    near::NearPoints,
    plane::{Place, Plane, SIDE},
    root::root,
};
use crate::trigonometry::{radians, sin_cos};

/// The coarsest level: each cell covers 4 x 4 map cells, the window 256 x 256.
pub const MAX_LEVEL: u32 = 2;

/// 32 cells of a map row: a row of a tile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GroundRow {
    /// The states of the cells.
    pub cells: Row,
    /// The cells covered by cameras.
    pub covered: u32,
}

/// A round object that is not on the map, or moves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Mover {
    /// The object's centre: its x in `map`.
    pub x: Millimetres,
    /// The object's centre: its y in `map`.
    pub y: Millimetres,
    /// Velocity along `map`'s x, in mm/s.
    pub velocity_x: i16,
    /// Velocity along `map`'s y, in mm/s.
    pub velocity_y: i16,
    /// Radius, in millimetres.
    pub radius: u16,
    /// Whether it is a person: the robot waits for people.
    pub is_person: bool,
    /// Whether the person sits or lies. Such a person does not step aside: the robot does not wait,
    /// and keeps farther away.
    pub is_at_rest: bool,
}

impl Mover {
    /// Below this speed it counts as standing, in mm/s.
    const STANDS: u16 = 100;
    /// Width of the costly ground around a person at rest, in millimetres: the reach of an arm.
    const ARM: i32 = 400;

    /// Whether it stays where it is; the velocity of a person at rest is that of arms and legs.
    pub fn stands(&self) -> bool {
        self.is_at_rest
            || self.velocity_x.unsigned_abs() < Self::STANDS
                && self.velocity_y.unsigned_abs() < Self::STANDS
    }
}

/// What a straight line between two cells crosses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Line {
    /// Only free cells.
    Clear {
        /// Number of costly cells among them.
        dear: u32,
    },
    /// A cell that is not free.
    Blocked,
    /// Only free cells up to the rim of the window; this is the last one.
    Leaves(Place),
}

/// Blind ground that could not be seen from where it was expected to be visible: ignored when
/// exploring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GivenUp {
    /// The place from which it could not be seen, in `map`.
    pub at: Waypoint,
    /// Radius around it, in millimetres.
    pub reach: u16,
}

/// The inputs of [`PlanningWindow::fill`].
#[derive(Clone, Copy, Debug)]
pub struct WindowInputs<'v> {
    /// `base_link` in `map`: the centre of the window.
    pub pose: Pose,
    /// The side of a map cell.
    pub resolution: Millimetres,
    /// The window's cells are 2^`level` times as wide as the map's; at most [`MAX_LEVEL`].
    pub level: u32,
    /// Radius of the circle that must be free for the robot, in millimetres.
    pub radius: u16,
    /// Points seen by the robot's own sensor: occupied, even if the map says otherwise.
    pub near: &'v NearPoints,
    /// Objects seen by the cameras: occupied if they stand, free if they move.
    pub movers: &'v [Mover],
    /// Blind ground that is ignored, because it could not be seen.
    pub given_up: &'v [GivenUp],
    /// Whether to explore ground covered by cameras, too.
    pub explore_covered: bool,
}

/// A map of 64 x 64 cells around the robot (1.5 KiB). The outermost cells are never free.
#[derive(Clone, Debug)]
pub struct PlanningWindow {
    /// The cells in which the robot's centre may be. At level 0 every point of such a cell is
    /// farther than the radius from everything occupied. At coarser levels, where walls are as
    /// thick as the larger cells, this holds for the cell's centre only: such windows are for
    /// planning, not for driving.
    pub free: Plane,
    /// The free cells where a movable object stood when it was last seen, and those around a person
    /// who sits or lies.
    pub dear: Plane,
    /// Whether `dear` contains any cell.
    pub(super) has_dear: bool,
    /// The free cells near unmapped blind ground.
    pub frontier: Plane,
    /// The south-western corner in `map`, in millimetres.
    corner: (i32, i32),
    /// The side of a cell in millimetres.
    cell: i32,
}

impl PlanningWindow {
    /// A window that has not been filled: all zero bits.
    pub const EMPTY: Self = Self {
        free: Plane::EMPTY,
        dear: Plane::EMPTY,
        has_dear: false,
        frontier: Plane::EMPTY,
        corner: (0, 0),
        cell: 0,
    };

    /// Fills the window from the map. `ground(column, row)` returns the 32 map cells in a column of
    /// tiles and a row of cells. Takes 1 KiB of stack.
    pub fn fill(&mut self, view: &WindowInputs<'_>, ground: impl Fn(i32, i32) -> GroundRow) {
        let level = view.level.min(MAX_LEVEL);
        let resolution = view.resolution.0.max(1);
        self.cell = resolution.saturating_mul(1 << level);
        let corner = |middle: Millimetres| {
            middle.0.div_euclid(self.cell.max(1)).saturating_sub(SIDE as i32 / 2)
        };
        let (west, south) = (corner(view.pose.x), corner(view.pose.y));
        self.corner = (west.saturating_mul(self.cell), south.saturating_mul(self.cell));
        let mut occupied = Plane::EMPTY;
        self.read((west, south), level, &ground, view.explore_covered, &mut occupied);
        self.clear_under(view, &mut occupied);
        let standing = view.movers.iter().filter(|mover| mover.stands());
        for mover in standing {
            let (middle, radius) = (self.relative(mover.x, mover.y), i32::from(mover.radius));
            add_disc(&mut occupied, middle, radius, self.cell);
            if mover.is_at_rest {
                add_disc(&mut self.dear, middle, radius + Mover::ARM, self.cell);
            }
        }
        let to_window = self.of_robot(view.pose);
        for &(x, y) in view.near.points() {
            if let Some(place) = to_window(x, y) {
                occupied.insert(place);
            }
        }
        self.bound_frontier(view, &occupied);
        self.inflate(view.radius, level, &occupied);
    }

    /// Reads the cells' states: free, movable (into `dear`), blind and unknown (into `frontier`),
    /// and occupied.
    fn read(
        &mut self,
        (west, south): (i32, i32),
        level: u32,
        ground: &impl Fn(i32, i32) -> GroundRow,
        explore_covered: bool,
        occupied: &mut Plane,
    ) {
        let first = west.saturating_mul(1 << level);
        let column = first.div_euclid(TILE_SIDE as i32);
        let columns = (2 << level) + 1;
        for y in 0..SIDE {
            let (mut free, mut movable, mut settled, mut fixed) = (0, 0, 0, 0);
            let row = south.saturating_add(y as i32).saturating_mul(1 << level);
            for column in column..column.saturating_add(columns) {
                // The rows that share a cell, before their columns that do: fewer steps.
                let mut merged = [0; 4];
                for row in row..row.saturating_add(1 << level) {
                    let GroundRow { cells: Row { low, high }, covered } = ground(column, row);
                    let seen = if explore_covered { 0 } else { covered };
                    let states = [low & !high, low & high, high & !low, low | high | seen];
                    merged.iter_mut().zip(states).for_each(|(merged, state)| *merged |= state);
                }
                let east = column.saturating_mul(TILE_SIDE as i32).saturating_sub(first);
                let at = |cells| shifted(squeezed(cells, level), east >> level);
                free |= at(merged[0]);
                movable |= at(merged[1]);
                fixed |= at(merged[2]);
                settled |= at(merged[3]);
            }
            *self.free.row_mut(y) = free | movable;
            *self.dear.row_mut(y) = movable;
            *self.frontier.row_mut(y) = !settled;
            *occupied.row_mut(y) = fixed;
        }
    }

    /// Clears the cells under the robot.
    fn clear_under(&mut self, view: &WindowInputs<'_>, occupied: &mut Plane) {
        let Pose { x, y, .. } = view.pose;
        disc(self.relative(x, y), view.radius.into(), self.cell, |y, cells| {
            *self.free.row_mut(y) |= cells;
            *self.dear.row_mut(y) &= !cells;
            *self.frontier.row_mut(y) &= !cells;
            *occupied.row_mut(y) &= !cells;
        });
    }

    /// Replaces the blind cells in `frontier` by the free cells near them. As the robot keeps its
    /// distance from walls, "near" includes that distance; it is measured around walls, not through
    /// them.
    fn bound_frontier(&mut self, view: &WindowInputs<'_>, occupied: &Plane) {
        let mut open = self.free;
        for y in 0..SIDE {
            *open.row_mut(y) &= !occupied.row(y);
        }
        self.frontier.grow(&open, false);
        for GivenUp { at, reach } in view.given_up {
            disc(self.relative(at.x, at.y), i32::from(*reach), self.cell, |y, cells| {
                *self.frontier.row_mut(y) &= !cells;
            });
        }
        for step in 0..frontier_steps(view.radius, self.cell) {
            self.frontier.grow(&open, step % 2 == 1);
        }
    }

    /// Removes from `free` the cells too close to anything occupied.
    fn inflate(&mut self, radius: u16, level: u32, occupied: &Plane) {
        let mut near = Plane::EMPTY;
        // Coarse windows need no margin: their walls are already thick, and the route is planned
        // again in a finer window.
        let diagonal = if level == 0 { (i64::from(self.cell) * 1_448) >> 10 } else { 0 };
        let reach = 2 * i64::from(radius) + diagonal;
        inflate(occupied, reach, self.cell, &mut near);
        for y in 0..SIDE {
            let inner = if (1..SIDE - 1).contains(&y) { Plane::INNER } else { 0 };
            *self.free.row_mut(y) &= !near.row(y) & inner;
        }
        if !self.dear.is_empty() {
            near = Plane::EMPTY;
            inflate(&self.dear, reach, self.cell, &mut near);
            self.dear = near;
        }
        for y in 0..SIDE {
            let free = self.free.row(y);
            *self.dear.row_mut(y) &= free;
            *self.frontier.row_mut(y) &= free;
        }
        self.has_dear = !self.dear.is_empty();
    }

    /// A point relative to the south-western corner, in millimetres.
    fn relative(&self, x: Millimetres, y: Millimetres) -> (f32, f32) {
        (x.0.saturating_sub(self.corner.0) as f32, y.0.saturating_sub(self.corner.1) as f32)
    }

    /// Column and row of a point in `map`, relative to the corner; the point may be outside.
    pub fn column_and_row(&self, point: Waypoint) -> (i32, i32) {
        let along = |it: i32, corner: i32| it.saturating_sub(corner).div_euclid(self.cell.max(1));
        (along(point.x.0, self.corner.0), along(point.y.0, self.corner.1))
    }

    /// The cell of a point in `map`, or `None` outside the window.
    pub fn place(&self, point: Waypoint) -> Option<Place> {
        let (x, y) = self.column_and_row(point);
        Place::new(x, y)
    }

    /// Maps a point in `base_link` (forward, left) to its cell.
    pub(super) fn of_robot(&self, pose: Pose) -> impl Fn(f32, f32) -> Option<Place> + use<> {
        let cells = 1.0 / self.cell.max(1) as f32;
        let (sin, cos) = sin_cos(radians(pose.heading));
        let (sin, cos) = (sin * cells, cos * cells);
        let (from_x, from_y) = self.relative(pose.x, pose.y);
        let (from_x, from_y) = (from_x * cells, from_y * cells);
        move |forward, left| {
            let x = from_x + forward * cos - left * sin;
            let y = from_y + forward * sin + left * cos;
            // A point just outside is mapped to the rim, which is never free.
            Place::new(x as i32, y as i32)
        }
    }

    /// The centre of a cell, in `map`.
    pub fn middle(&self, place: Place) -> Waypoint {
        let along = |corner: i32, at: u8| {
            Millimetres(corner.saturating_add(i32::from(at) * self.cell + self.cell / 2))
        };
        Waypoint { x: along(self.corner.0, place.x), y: along(self.corner.1, place.y) }
    }

    /// The side of a cell, in millimetres.
    pub fn cell(&self) -> i32 {
        self.cell
    }

    /// The free cell nearest to `to`, within a few cells; `to` itself if it is free.
    pub(super) fn nearest_free(&self, to: Place) -> Option<Place> {
        self.nearest_outside(to, &Plane::EMPTY)
    }

    /// The same among the free cells that can't be reached from that cell. In a coarse window, with its thick
    /// walls, the robot may be in the one without being cut off from the other.
    pub(super) fn nearest_cut_off(&self, to: Place) -> Option<Place> {
        let mut reached = Plane::EMPTY;
        reached.insert(self.nearest_free(to)?);
        reached.flood(&self.free);
        self.nearest_outside(to, &reached)
    }

    /// The free cell nearest to `to`, within a few cells, that is not in `left_out`.
    fn nearest_outside(&self, to: Place, left_out: &Plane) -> Option<Place> {
        /// Larger than the errors of the pose and the map, in cells.
        const REACH: i32 = 6;
        let (x, y) = to.column_and_row();
        let about = (-REACH..=REACH).flat_map(|dy| (-REACH..=REACH).map(move |dx| (dx, dy)));
        let free = about.filter_map(|(dx, dy)| {
            let is_free = |&it: &Place| self.free.has(it) && !left_out.has(it);
            let place = Place::new(x + dx, y + dy).filter(is_free)?;
            Some((dx * dx + dy * dy, place))
        });
        free.min_by_key(|&(square, _)| square).map(|(_, place)| place)
    }

    /// Whether the straight line between two cell centres touches only free cells. About 20
    /// instructions per cell.
    pub fn sees(&self, from: Place, to: Place) -> bool {
        matches!(self.line(from, to.column_and_row()), Line::Clear { .. })
    }

    /// What a straight line crosses, from `from` (not included) to `to`, which may be outside the
    /// window.
    #[inline(never)]
    pub(super) fn line(&self, from: Place, to: (i32, i32)) -> Line {
        let (across, up) = (to.0 - i32::from(from.x), to.1 - i32::from(from.y));
        // Most blocked lines are blocked at one of these three points, so these are checked first.
        if Place::new(to.0, to.1).is_some() {
            for quarters in [2, 1, 3] {
                let along = |from: u8, way| (i32::from(from) + ((quarters * way + 2) >> 2)) as u8;
                let place = Place { x: along(from.x, across), y: along(from.y, up) };
                if !self.free.has(place) {
                    return Line::Blocked;
                }
            }
        }
        let (east, step_y) = (across > 0, up.signum());
        let (across, up) = (across.abs(), up.abs());
        let mut cell = 1u64 << (from.x % 64);
        let mut y = i32::from(from.y);
        let mut row = self.free.row(from.y.into());
        // Twice the distances to the next vertical and the next horizontal side, each multiplied by
        // the length along the other axis: the sign of the difference says which side the line
        // crosses first.
        let mut ahead = up - across;
        let mut left = across + up;
        let mut dear = 0;
        while left > 0 {
            let side = ahead;
            if side <= 0 {
                cell = if east { cell << 1 } else { cell >> 1 };
                ahead += 2 * up;
                left -= 1;
            }
            if side >= 0 {
                y += step_y;
                row = self.free.row(y as usize);
                ahead -= 2 * across;
                left -= 1;
            }
            // The line crosses a corner: both cells beside it must be free, too.
            let beside = side == 0 && {
                let last = if east { cell >> 1 } else { cell << 1 };
                row & last == 0 || self.free.row((y - step_y) as usize) & cell == 0
            };
            // The rim is never free, so a line that leaves the window stops there.
            if row & cell == 0 || beside {
                let x = cell.trailing_zeros() as i32;
                let rim = |it: i32| it == 0 || it == SIDE as i32 - 1;
                if !rim(x) && !rim(y) {
                    return Line::Blocked;
                }
                let last_x =
                    if side > 0 { x } else { x - across.min(1) * if east { 1 } else { -1 } };
                let last_y = if side < 0 { y } else { y - step_y };
                return Place::new(last_x, last_y).map_or(Line::Blocked, Line::Leaves);
            }
            if self.has_dear && self.dear.row(y as usize) & cell != 0 {
                dear += 1;
            }
        }
        Line::Clear { dear }
    }

    /// Whether the straight line between two points of `map` crosses only free cells. Cells outside
    /// the window count as free.
    pub fn is_clear(&self, from: Waypoint, to: Waypoint) -> bool {
        match (self.place(from), self.place(to)) {
            (Some(from), Some(to)) => self.sees(from, to),
            (Some(from), None) => self.free.has(from),
            _ => true,
        }
    }
}

/// Radius of the ground to give up around a frontier cell from which blind ground could not be
/// seen, in millimetres.
pub(super) fn frontier_reach(radius: u16, cell: i32) -> u16 {
    let cells = frontier_steps(radius, cell) + 2;
    u16::try_from(cells.saturating_mul(cell)).unwrap_or(u16::MAX)
}

/// Maximum distance from blind ground to the free cells that count as its frontier, in cells: large
/// enough that the robot can get there even beside a wall.
fn frontier_steps(radius: u16, cell: i32) -> i32 {
    (i32::from(radius) / cell.max(1) + 2).min(SIDE as i32)
}

/// The bits with each group of 2 or 4 neighbours (levels 1 and 2) merged into one.
fn squeezed(mut cells: u32, level: u32) -> u32 {
    for _ in 0..level {
        cells = (cells | cells >> 1) & 0x5555_5555;
        cells = (cells | cells >> 1) & 0x3333_3333;
        cells = (cells | cells >> 2) & 0x0f0f_0f0f;
        cells = (cells | cells >> 4) & 0x00ff_00ff;
        cells = (cells | cells >> 8) & 0x0000_ffff;
    }
    cells
}

/// `cells` shifted so that the first is at column `east`; cells outside the window are dropped.
fn shifted(cells: u32, east: i32) -> u64 {
    let cells = u64::from(cells);
    let by = east.unsigned_abs();
    if east < 0 { cells.checked_shr(by) } else { cells.checked_shl(by) }.unwrap_or(0)
}

/// Calls `take` for each row of a disc with the cells whose centres are inside the disc. Its centre
/// `(x, y)` is relative to the window's corner; all lengths are in millimetres.
fn disc((x, y): (f32, f32), radius: i32, cell: i32, mut take: impl FnMut(usize, u64)) {
    let radius = radius as f32 / cell as f32;
    let (x, y) = (x / cell as f32 - 0.5, y / cell as f32 - 0.5);
    for row in 0..SIDE {
        let aside = row as f32 - y;
        let square = radius * radius - aside * aside;
        if square < 0.0 {
            continue;
        }
        let half = root(square);
        let from = libm::ceilf(x - half).max(0.0) as u32;
        let to = libm::floorf(x + half).min(SIDE as f32 - 1.0) as i32;
        if to >= 0 && from <= to as u32 {
            take(row, u64::MAX << (from % 64) & u64::MAX >> (63 - to as u32 % 64));
        }
    }
}

/// Adds a disc to a plane. Not inlined, so that the firmware has it once.
#[inline(never)]
fn add_disc(plane: &mut Plane, middle: (f32, f32), radius: i32, cell: i32) {
    disc(middle, radius, cell, |y, cells| *plane.row_mut(y) |= cells);
}

/// Maximum inflation of an obstacle, in cells.
const MAX_INFLATION: usize = 24;

/// Adds to `near` the cells whose centre is closer than half of `reach` to an occupied cell.
fn inflate(occupied: &Plane, reach: i64, cell: i32, near: &mut Plane) {
    // All lengths are doubled, to avoid fractions.
    let gap = |cells: usize| (2 * cells as i64 - 1).max(0) * i64::from(cell);
    // For each distance in rows from an occupied cell, the number of cells that it inflates to on
    // either side along the row, its own column included.
    let widths: [u8; MAX_INFLATION + 1] = core::array::from_fn(|aside| {
        let within = |along: &usize| gap(*along).pow(2) + gap(aside).pow(2) < reach.pow(2);
        if within(&0) { 1 + (1..=MAX_INFLATION).take_while(within).count() as u8 } else { 0 }
    });
    for y in 0..SIDE {
        let mut cells = occupied.row(y);
        if cells == 0 {
            continue;
        }
        let mut width = 1;
        for (aside, &wanted) in widths.iter().enumerate().rev() {
            while width < wanted {
                cells |= cells << 1 | cells >> 1;
                width += 1;
            }
            if wanted > 0 {
                if y >= aside {
                    *near.row_mut(y - aside) |= cells;
                }
                if y + aside < SIDE {
                    *near.row_mut(y + aside) |= cells;
                }
            }
        }
    }
}
