//! The static room: walls, doors and furniture, in a tree of bounding boxes.

use parry2d_f64::{
    bounding_volume::{Aabb, BoundingVolume},
    glamx::{DVec2, DVec3},
    partitioning::{Bvh, BvhBuildStrategy, TraversalAction},
    query::Ray,
};

use super::{
    scenario::{DoorConfig, FootprintConfig, FurnitureConfig, RoomConfig, Scenario, ScenarioError},
    shapes::{Footprint, Prism},
};

/// Maximum number of cells of a room.
const MAX_CELLS: f64 = 16e6;

/// Walls as the occupied cells of a grid, as in a ROS map.
#[derive(Clone, Debug)]
pub struct WallGrid {
    /// The side of a cell.
    pub resolution_m: f64,
    /// The lower left corner of the first cell in `map`, in metres.
    pub origin_m: [f64; 2],
    /// Number of cells along x.
    pub width: usize,
    /// Number of cells along y.
    pub height: usize,
    /// Whether each cell is wall, row by row from the lower left.
    pub occupied: Vec<bool>,
}

/// The walls, doors and furniture as prisms.
pub(super) struct Room {
    prisms: Vec<Prism>,
    /// For each prism its key in the scenario.
    keys: Vec<String>,
    height: f64,
    shade: Option<f64>,
    seamless: bool,
    tree: Bvh,
    outline: Vec<DVec2>,
    bounds: Aabb,
}

impl Room {
    /// The room of a scenario with some doors open and the others closed.
    pub(super) fn new(
        scenario: &Scenario,
        walls: Option<&WallGrid>,
        are_open: &[bool],
    ) -> Result<Self, ScenarioError> {
        let mut parts = Vec::new();
        match (&scenario.room.map, walls) {
            (Some(_), Some(grid)) => add_grid(&mut parts, scenario, grid)?,
            (Some(map), None) => {
                let problem = format!("names {}, but that map was not read", map.display());
                return Err(scenario.invalid("room.map", problem));
            }
            (None, _) => {}
        }
        let outline: Vec<DVec2> =
            scenario.room.outline_m.iter().map(|&point| DVec2::from(point)).collect();
        add_walls(&mut parts, scenario);
        for (index, config) in scenario.furniture.iter().enumerate() {
            let key = format!("furniture[{index}]");
            let prisms = furniture(config).ok_or_else(|| {
                scenario.invalid(format!("{key}.footprint.polygon.points_m"), "has no area")
            })?;
            parts.extend(prisms.into_iter().map(|prism| (prism, key.clone())));
        }
        for (index, door) in scenario.doors.iter().enumerate() {
            let leaf = leaf(door, are_open.get(index).copied().unwrap_or_default());
            parts.push((leaf, format!("doors[{index}]")));
        }
        let (prisms, keys): (Vec<Prism>, Vec<String>) = parts.into_iter().unzip();
        let boxes: Vec<Aabb> = prisms.iter().map(|prism| prism.footprint.bounds()).collect();
        let bounds = match walls {
            Some(grid) if outline.is_empty() => grid_bounds(grid),
            _ => outline_bounds(&outline, scenario.room.wall_thickness_m),
        };
        let tree = Bvh::from_leaves(BvhBuildStrategy::Binned, &boxes);
        let RoomConfig { height_m: height, shade, seamless, .. } = scenario.room;
        Ok(Self { prisms, keys, height, shade, seamless, tree, outline, bounds })
    }

    pub(super) fn prisms(&self) -> &[Prism] {
        &self.prisms
    }

    /// For each prism its key in the scenario.
    pub(super) fn keys(&self) -> &[String] {
        &self.keys
    }

    /// The reflectance of all of its parts; `None` if each has its own.
    pub(super) fn shade(&self) -> Option<f64> {
        self.shade
    }

    /// Whether the floor has no joints.
    pub(super) fn is_seamless(&self) -> bool {
        self.seamless
    }

    /// Height of the ceiling in metres.
    pub(super) fn height(&self) -> f64 {
        self.height
    }

    /// Whether a point is within the outer walls (within the map, for a room from a map).
    pub(super) fn encloses(&self, point: DVec2) -> bool {
        if self.outline.is_empty() {
            return self.bounds.contains_local_point(point);
        }
        // Even-odd rule: a ray to the right crosses the outline an odd number of times.
        let mut inside = false;
        for (index, &from) in self.outline.iter().enumerate() {
            let to = self.outline[(index + 1) % self.outline.len()];
            if (from.y > point.y) != (to.y > point.y) {
                let along = (point.y - from.y) / (to.y - from.y);
                inside ^= point.x < from.x + along * (to.x - from.x);
            }
        }
        inside
    }

    /// The prisms whose bounding boxes intersect a rectangle.
    pub(super) fn near<'a>(&'a self, rectangle: &'a Aabb) -> impl Iterator<Item = &'a Prism> {
        self.tree.intersect_aabb(rectangle).map(|index| &self.prisms[index as usize])
    }

    /// Whether a point is inside a prism that has some part between two heights.
    pub(super) fn is_solid(&self, point: DVec2, from: f64, to: f64) -> bool {
        let at = Aabb::new(point, point);
        self.near(&at).any(|prism| prism.reaches(from, to) && prism.footprint.contains(point))
    }

    /// The key of an obstacle that an upright cylinder meets when it moves between two points.
    pub(super) fn obstacle(
        &self,
        from: DVec2,
        to: DVec2,
        radius: f64,
        height: f64,
    ) -> Option<&str> {
        let reach = DVec2::splat(radius);
        let swept = Aabb::new(from.min(to) - reach, from.max(to) + reach);
        let mut found: Vec<u32> = self
            .tree
            .intersect_aabb(&swept)
            .filter(|&index| {
                let prism = &self.prisms[index as usize];
                prism.reaches(0.0, height) && prism.footprint.distance_to_way(from, to) < radius
            })
            .collect();
        found.sort_unstable();
        found.first().map(|&index| self.keys[index as usize].as_str())
    }

    /// The index of the first prism that a ray hits, and the hit as a multiple of `direction`, up to and
    /// including `limit`.
    pub(super) fn first_hit(
        &self,
        origin: DVec3,
        direction: DVec3,
        limit: f64,
    ) -> Option<(usize, f64)> {
        let level = direction.truncate();
        if level.length_squared() < 1e-20 {
            let at = Aabb::new(origin.truncate(), origin.truncate());
            return self
                .tree
                .intersect_aabb(&at)
                .filter_map(|index| {
                    let hit = self.prisms[index as usize].first_hit(origin, direction, limit)?;
                    Some((index as usize, hit))
                })
                .min_by(|(_, a), (_, b)| a.total_cmp(b));
        }
        let ray = Ray::new(origin.truncate(), level);
        // The tree looks for hits strictly below its limit; `limit` itself counts too.
        let (index, hit) = self.tree.cast_ray(&ray, limit * (1.0 + 1e-12), |index, best| {
            self.prisms[index as usize].first_hit(origin, direction, best.min(limit))
        })?;
        Some((index as usize, hit))
    }

    /// Whether the line between two points is free.
    pub(super) fn sees(&self, from: DVec3, to: DVec3) -> bool {
        let direction = to - from;
        let way = Aabb::new(from.truncate().min(to.truncate()), from.truncate().max(to.truncate()));
        let ray = Ray::new(from.truncate(), direction.truncate());
        let mut clear = true;
        self.tree.traverse(|node| {
            if !node.aabb().intersects(&way) || node.cast_ray(&ray, 1.0) > 1.0 {
                return TraversalAction::Prune;
            }
            let blocks =
                |index: u32| self.prisms[index as usize].first_hit(from, direction, 1.0).is_some();
            if node.leaf_data().is_some_and(blocks) {
                clear = false;
                return TraversalAction::EarlyExit;
            }
            TraversalAction::Continue
        });
        clear
    }
}

/// The grid cells of `map` that cover the room.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct CellGrid {
    pub(super) first: (i32, i32),
    pub(super) columns: usize,
    pub(super) rows: usize,
    /// Side of a cell in metres.
    pub(super) side: f64,
}

impl CellGrid {
    /// The grid that covers a room.
    pub(super) fn of(room: &Room, side: f64, scenario: &Scenario) -> Result<Self, ScenarioError> {
        let (low, high) = (room.bounds.mins / side, room.bounds.maxs / side);
        let first = (low.x.floor(), low.y.floor());
        let (columns, rows) = (high.x.ceil() - first.0, high.y.ceil() - first.1);
        if !(columns >= 1.0 && rows >= 1.0 && columns * rows <= MAX_CELLS) {
            let problem = format!(
                "has {columns} x {rows} cells of {side} m; make it smaller or the cells larger \
                 (at most {MAX_CELLS} cells)"
            );
            return Err(scenario.invalid("room", problem));
        }
        Ok(Self {
            first: (first.0 as i32, first.1 as i32),
            columns: columns as usize,
            rows: rows as usize,
            side,
        })
    }

    /// Number of cells.
    pub(super) fn count(&self) -> usize {
        self.columns * self.rows
    }

    /// The cell with an index; indices go row by row from the lower left.
    pub(super) fn cell(&self, index: usize) -> (i32, i32) {
        (self.first.0 + (index % self.columns) as i32, self.first.1 + (index / self.columns) as i32)
    }

    /// The index of a cell; `None` outside the room.
    pub(super) fn index(&self, cell: (i32, i32)) -> Option<usize> {
        let column = usize::try_from(cell.0.checked_sub(self.first.0)?).ok()?;
        let row = usize::try_from(cell.1.checked_sub(self.first.1)?).ok()?;
        (column < self.columns && row < self.rows).then_some(row * self.columns + column)
    }

    /// The cell that contains a point.
    pub(super) fn cell_at(&self, point: DVec2) -> (i32, i32) {
        ((point.x / self.side).floor() as i32, (point.y / self.side).floor() as i32)
    }

    pub(super) fn centre(&self, cell: (i32, i32)) -> DVec2 {
        DVec2::new(f64::from(cell.0) + 0.5, f64::from(cell.1) + 0.5) * self.side
    }

    pub(super) fn square(&self, cell: (i32, i32)) -> Aabb {
        Aabb::from_half_extents(self.centre(cell), DVec2::splat(self.side / 2.0))
    }

    /// The cells of the room that intersect a rectangle.
    pub(super) fn within(&self, rectangle: &Aabb) -> impl Iterator<Item = (i32, i32)> + use<> {
        let (low, high) = (self.cell_at(rectangle.mins), self.cell_at(rectangle.maxs));
        let last = (self.first.0 + self.columns as i32 - 1, self.first.1 + self.rows as i32 - 1);
        let columns = low.0.max(self.first.0)..=high.0.min(last.0);
        let rows = low.1.max(self.first.1)..=high.1.min(last.1);
        rows.flat_map(move |row| columns.clone().map(move |column| (column, row)))
    }

    /// The cells of the room that a disc covers, fully or partly.
    pub(super) fn under_disc(
        &self,
        centre: DVec2,
        radius: f64,
    ) -> impl Iterator<Item = (i32, i32)> + use<> {
        let cells = *self;
        let reach = DVec2::splat(radius);
        self.within(&Aabb::new(centre - reach, centre + reach)).filter(move |&cell| {
            let square = cells.square(cell);
            centre.clamp(square.mins, square.maxs).distance_squared(centre) < radius * radius
        })
    }
}

fn add_walls(parts: &mut Vec<(Prism, String)>, scenario: &Scenario) {
    let room = &scenario.room;
    let count = room.outline_m.len();
    for index in 0..count {
        let ends = [room.outline_m[index], room.outline_m[(index + 1) % count]];
        let wall = wall(ends, room.wall_thickness_m, room.height_m);
        parts.push((wall, format!("room.outline_m[{index}]")));
    }
    for (index, config) in room.walls.iter().enumerate() {
        let thickness = config.thickness_m.unwrap_or(room.wall_thickness_m);
        let height = config.height_m.unwrap_or(room.height_m);
        for ends in config.points_m.windows(2) {
            let wall = wall([ends[0], ends[1]], thickness, height);
            parts.push((wall, format!("room.walls[{index}]")));
        }
    }
}

/// The leaf of a door, open or closed.
pub(super) fn leaf(door: &DoorConfig, is_open: bool) -> Prism {
    let turn = if is_open { door.swing_deg } else { 0.0 };
    let heading = (door.heading_deg + turn).to_radians();
    let along = DVec2::new(libm::cos(heading), libm::sin(heading)) * door.width_m;
    let centre = DVec2::from(door.hinge_m) + along / 2.0;
    let size = DVec2::new(door.width_m, door.thickness_m);
    Prism {
        footprint: Footprint::rectangle(centre, size, heading),
        bottom: 0.0,
        top: door.height_m,
    }
}

/// A straight wall along its centre line, extended by half its thickness at both ends to close corners.
fn wall([from, to]: [[f64; 2]; 2], thickness: f64, height: f64) -> Prism {
    let (from, to) = (DVec2::from(from), DVec2::from(to));
    let way = to - from;
    let heading = libm::atan2(way.y, way.x);
    let size = DVec2::new(way.length() + thickness, thickness);
    Prism {
        footprint: Footprint::rectangle((from + to) / 2.0, size, heading),
        bottom: 0.0,
        top: height,
    }
}

/// The prisms of a piece of furniture; `None` for a polygon without area.
pub(super) fn furniture(config: &FurnitureConfig) -> Option<Vec<Prism>> {
    let mut parts = Vec::new();
    if let (FootprintConfig::Box { centre_m, size_m, heading_deg }, Some(side)) =
        (&config.footprint, config.legs_m)
    {
        let (centre, size) = (DVec2::from(*centre_m), DVec2::from(*size_m));
        let heading = heading_deg.to_radians();
        let (sine, cosine) = (libm::sin(heading), libm::cos(heading));
        let corner = (size - DVec2::splat(side)) / 2.0;
        for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
            let offset = DVec2::new(cosine, sine).rotate(corner * DVec2::new(x, y));
            let leg = Footprint::rectangle(centre + offset, DVec2::splat(side), heading);
            parts.push(Prism { footprint: leg, bottom: 0.0, top: config.bottom_m });
        }
    }
    let footprint = footprint(&config.footprint)?;
    parts.push(Prism { footprint, bottom: config.bottom_m, top: config.top_m });
    Some(parts)
}

/// The ground under something; `None` for a polygon without area.
pub(super) fn footprint(config: &FootprintConfig) -> Option<Footprint> {
    match config {
        FootprintConfig::Box { centre_m, size_m, heading_deg } => Some(Footprint::rectangle(
            DVec2::from(*centre_m),
            DVec2::from(*size_m),
            heading_deg.to_radians(),
        )),
        FootprintConfig::Disc { centre_m, radius_m } => {
            Some(Footprint::disc(DVec2::from(*centre_m), *radius_m))
        }
        FootprintConfig::Polygon { points_m } => {
            let corners: Vec<DVec2> = points_m.iter().map(|&point| DVec2::from(point)).collect();
            Footprint::polygon(&corners)
        }
    }
}

/// Covers the occupied cells with few boxes: runs of a row, extended upward while the rows are equal.
fn add_grid(
    parts: &mut Vec<(Prism, String)>,
    scenario: &Scenario,
    grid: &WallGrid,
) -> Result<(), ScenarioError> {
    let numbers = [grid.resolution_m, grid.origin_m[0], grid.origin_m[1]];
    if grid.occupied.len() != grid.width.saturating_mul(grid.height)
        || !numbers.iter().all(|number| number.is_finite())
        || grid.resolution_m <= 0.0
    {
        return Err(scenario.invalid("room.map", "is not a grid of cells with a finite origin"));
    }
    let mut left = grid.occupied.clone();
    for row in 0..grid.height {
        let mut column = 0;
        while column < grid.width {
            if !left[row * grid.width + column] {
                column += 1;
                continue;
            }
            let run = left[row * grid.width..][column..grid.width]
                .iter()
                .take_while(|&&occupied| occupied)
                .count();
            let mut rows = 0;
            while row + rows < grid.height {
                let cells = &mut left[(row + rows) * grid.width..][column..column + run];
                if !cells.iter().all(|&occupied| occupied) {
                    break;
                }
                cells.fill(false);
                rows += 1;
            }
            let size = DVec2::new(run as f64, rows as f64) * grid.resolution_m;
            let corner = DVec2::from(grid.origin_m)
                + DVec2::new(column as f64, row as f64) * grid.resolution_m;
            let footprint = Footprint::rectangle(corner + size / 2.0, size, 0.0);
            let prism = Prism { footprint, bottom: 0.0, top: scenario.room.height_m };
            parts.push((prism, "room.map".to_owned()));
            column += run;
        }
    }
    Ok(())
}

fn grid_bounds(grid: &WallGrid) -> Aabb {
    let low = DVec2::from(grid.origin_m);
    let size = DVec2::new(grid.width as f64, grid.height as f64) * grid.resolution_m;
    Aabb::new(low, low + size)
}

fn outline_bounds(outline: &[DVec2], thickness: f64) -> Aabb {
    let corners = || outline.iter().copied();
    let low = corners().reduce(DVec2::min).unwrap_or_default();
    let high = corners().reduce(DVec2::max).unwrap_or_default();
    let reach = DVec2::splat(thickness / 2.0);
    Aabb::new(low - reach, high + reach)
}
