//! Ideal cameras: they see every cell and localise every robot in view.
//!
//! Occlusion by the room is computed once per room. Each frame considers only people and robots:
//! the cells that they cover, and their shadows.

use libm::tan;
use parry2d_f64::{
    bounding_volume::Aabb,
    glamx::{DVec2, DVec3},
};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use ubimap_protocol::{tile::Cell, units::RobotId};

use super::{
    mounting::Mounting,
    plane_pose::PlanePose,
    robots::SimRobot,
    room::{CellGrid, Room},
    route::Body,
    scenario::CameraConfig,
    sensor::cylinder,
    shapes::Prism,
};
use crate::camera::Sighting;

/// Minimum height of a camera above a body in metres; below it, the body's shadow is unbounded.
const HEADROOM: f64 = 0.05;

/// A cell in view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct VisibleCell {
    pub(super) cell: (i32, i32),
    /// Free or occupied.
    pub(super) state: Cell,
    /// A visible point of the cell.
    pub(super) target: DVec3,
}

/// A robot as seen by ideal cameras.
#[derive(Clone, Copy, Debug)]
pub(super) struct VisibleRobot {
    pub(super) id: RobotId,
    pub(super) pose: PlanePose,
    pub(super) body: Body,
}

impl VisibleRobot {
    pub(super) fn of(robot: &SimRobot) -> Self {
        Self { id: robot.id(), pose: robot.identified(), body: robot.body() }
    }
}

/// The content of one frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct IdealFrame {
    pub(super) robots: Vec<Sighting>,
    pub(super) cells: Vec<((i32, i32), Cell)>,
}

/// An ideal camera; only the poses of robots are noisy.
pub(super) struct IdealCamera {
    field: FieldOfView,
    position_noise: f64,
    heading_noise: f64,
    dice: ChaCha8Rng,
    cells: CellGrid,
    robot_height: f64,
    has_depth: bool,
    /// The cells visible without people and robots; empty without a depth sensor.
    visible: Vec<VisibleCell>,
    /// For each cell its index in `visible` plus one; zero for invisible cells.
    visible_at: Vec<u32>,
}

impl IdealCamera {
    pub(super) fn new(
        config: &CameraConfig,
        room: &Room,
        cells: CellGrid,
        robot_height: f64,
        dice: ChaCha8Rng,
    ) -> Self {
        let mut camera = Self {
            field: FieldOfView::new(config),
            position_noise: config.position_noise_m,
            heading_noise: config.heading_noise_deg.to_radians(),
            dice,
            cells,
            robot_height,
            has_depth: config.has_depth,
            visible: Vec::new(),
            visible_at: Vec::new(),
        };
        camera.look_again(room);
        camera
    }

    /// Recomputes the visible cells after the room has changed.
    pub(super) fn look_again(&mut self, room: &Room) {
        if !self.has_depth {
            return;
        }
        self.visible = visible(&self.field, room, self.cells, self.robot_height);
        self.visible_at = vec![0; self.cells.count()];
        for (number, seen) in (1..).zip(&self.visible) {
            if let Some(index) = self.cells.index(seen.cell) {
                self.visible_at[index] = number;
            }
        }
    }

    /// The cells visible without people and robots.
    pub(super) fn visible(&self) -> &[VisibleCell] {
        &self.visible
    }

    #[cfg(test)]
    pub(super) fn position(&self) -> DVec3 {
        self.field.position
    }

    /// Takes a frame; with cells only if `with_cells`.
    pub(super) fn frame(
        &mut self,
        room: &Room,
        robots: &[VisibleRobot],
        people: &[Body],
        with_cells: bool,
    ) -> IdealFrame {
        let bodies: Vec<Body> =
            robots.iter().map(|robot| robot.body).chain(people.iter().copied()).collect();
        let prisms: Vec<Prism> = bodies.iter().map(cylinder).collect();
        let mut localised = Vec::new();
        let mut frame = IdealFrame::default();
        for (index, robot) in robots.iter().enumerate() {
            // The same random numbers are drawn whether the robot is in view or not.
            let mut noise = || -> f64 { StandardNormal.sample(&mut self.dice) };
            let (x, y, turn) = (noise(), noise(), noise());
            let top = robot.body.centre.extend(robot.body.height);
            if self.field.covers(top)
                && room.sees(self.field.position, top)
                && !is_hidden(&prisms, Some(index), self.field.position, top)
            {
                let offset = DVec2::new(x, y) * self.position_noise;
                let measured = PlanePose {
                    position: robot.pose.position + offset,
                    heading: robot.pose.heading + turn * self.heading_noise,
                };
                frame.robots.push(Sighting::usual(robot.id, measured.quantised()));
                localised.push(robot.body);
            }
        }
        if with_cells && self.has_depth {
            frame.cells = self.cells_in_view(room, &localised, robots.len(), &bodies, &prisms);
        }
        frame
    }

    /// Free, occupied and movable cells. `bodies` holds the robots first, then the people.
    fn cells_in_view(
        &self,
        room: &Room,
        localised: &[Body],
        robots: usize,
        bodies: &[Body],
        prisms: &[Prism],
    ) -> Vec<((i32, i32), Cell)> {
        let mut hidden = vec![false; self.visible.len()];
        for (body, prism) in bodies.iter().zip(prisms) {
            for index in self.shadow(body).filter_map(|cell| self.visible_index(cell)) {
                let target = self.visible[index].target;
                let way = target - self.field.position;
                hidden[index] |= prism.first_hit(self.field.position, way, 1.0).is_some();
            }
        }
        let under = |body: &Body| self.cells.under_disc(body.centre, body.radius);
        for index in localised.iter().flat_map(under).filter_map(|cell| self.visible_index(cell)) {
            hidden[index] = true;
        }
        let mut moving = Vec::new();
        for (number, person) in bodies.iter().enumerate().skip(robots) {
            for cell in under(person) {
                let top = self.cells.centre(cell).extend(person.height);
                let is_seen = self.field.covers(top)
                    && room.sees(self.field.position, top)
                    && !is_hidden(prisms, Some(number), self.field.position, top);
                if let Some(index) = self.visible_index(cell) {
                    // The person hides the floor beneath, whether visible or not.
                    hidden[index] = true;
                }
                if is_seen {
                    moving.push((cell, Cell::Movable));
                }
            }
        }
        moving.sort_unstable_by_key(|&(cell, _)| cell);
        moving.dedup();
        let fixed = self.visible.iter().zip(hidden).filter(|(_, hidden)| !hidden);
        fixed.map(|(seen, _)| (seen.cell, seen.state)).chain(moving).collect()
    }

    fn visible_index(&self, cell: (i32, i32)) -> Option<usize> {
        let number = self.visible_at[self.cells.index(cell)?];
        (number as usize).checked_sub(1)
    }

    /// The cells that a body may hide: around its base and in its shadow on the floor.
    fn shadow(&self, body: &Body) -> impl Iterator<Item = (i32, i32)> + use<> {
        let eye = self.field.position;
        let reach = DVec2::splat(body.radius);
        let foot = Aabb::new(body.centre - reach, body.centre + reach);
        let below = eye.z - body.height;
        let rectangle = if below < HEADROOM {
            // At or above the camera: the shadow extends to the camera's range.
            let range = DVec2::splat(self.field.range);
            Aabb::new(eye.truncate() - range, eye.truncate() + range)
        } else {
            let stretch = eye.z / below;
            let cast = |point: DVec2| eye.truncate() + (point - eye.truncate()) * stretch;
            let (a, b) = (cast(foot.mins), cast(foot.maxs));
            Aabb::new(foot.mins.min(a), foot.maxs.max(b))
        };
        self.cells.within(&rectangle)
    }
}

/// A camera's position and its viewing pyramid.
struct FieldOfView {
    position: DVec3,
    forward: DVec3,
    right: DVec3,
    up: DVec3,
    /// Tangents of half the horizontal and half the vertical field of view.
    half: (f64, f64),
    range: f64,
}

impl FieldOfView {
    fn new(config: &CameraConfig) -> Self {
        let Mounting { position, forward, right, up } = Mounting::new(config);
        let half_tangent = |degrees: f64| tan(degrees.to_radians() / 2.0);
        Self {
            position,
            forward,
            right,
            up,
            half: (half_tangent(config.horizontal_fov_deg), half_tangent(config.vertical_fov_deg)),
            range: config.range_m,
        }
    }

    /// Whether a point is in the field of view, ignoring occlusion.
    fn covers(&self, point: DVec3) -> bool {
        let way = point - self.position;
        let depth = way.dot(self.forward);
        depth > 0.0
            && way.dot(self.right).abs() <= depth * self.half.0
            && way.dot(self.up).abs() <= depth * self.half.1
            && way.length_squared() <= self.range * self.range
    }
}

/// Whether a body other than `but` occludes `to` from `from`.
fn is_hidden(prisms: &[Prism], but: Option<usize>, from: DVec3, to: DVec3) -> bool {
    prisms
        .iter()
        .enumerate()
        .any(|(index, prism)| Some(index) != but && prism.first_hit(from, to - from, 1.0).is_some())
}

/// The cells that a camera sees without people and robots.
fn visible(
    field: &FieldOfView,
    room: &Room,
    cells: CellGrid,
    robot_height: f64,
) -> Vec<VisibleCell> {
    let reach = DVec2::splat(field.range);
    let eye = field.position.truncate();
    let mut visible = Vec::new();
    for cell in cells.within(&Aabb::new(eye - reach, eye + reach)) {
        let square = cells.square(cell);
        let standing: Vec<&Prism> = room
            .near(&square)
            .filter(|prism| prism.reaches(0.0, robot_height) && prism.footprint.overlaps(&square))
            .collect();
        if standing.is_empty() {
            let target = cells.centre(cell).extend(0.0);
            if field.covers(target) && room.sees(field.position, target) {
                visible.push(VisibleCell { cell, state: Cell::Free, target });
            }
        } else if let Some(target) = seen_part(field, room, cells, cell, robot_height, &standing) {
            visible.push(VisibleCell { cell, state: Cell::Occupied, target });
        }
    }
    visible
}

/// A visible point of what stands in a cell, on top or on a side; `None` if there is none.
fn seen_part(
    field: &FieldOfView,
    room: &Room,
    cells: CellGrid,
    cell: (i32, i32),
    robot_height: f64,
    standing: &[&Prism],
) -> Option<DVec3> {
    let square = cells.square(cell);
    standing.iter().find_map(|prism| {
        let aim = prism.footprint.nearest(cells.centre(cell));
        let side = (prism.bottom + prism.top.min(robot_height)) / 2.0;
        [prism.top, side].into_iter().find_map(|height| {
            if height >= field.position.z || !square.contains_local_point(aim) {
                return None;
            }
            // Slightly beyond the aim point, which may lie exactly on the edge.
            let way = aim.extend(height) - field.position;
            let (hit, at) = room.first_hit(field.position, way, 1.0 + 1e-6)?;
            let point = field.position + way * at;
            let is_here = cells.cell_at(point.truncate()) == cell;
            let stands = room.prisms()[hit].reaches(0.0, robot_height);
            // Slightly in front of the surface, so that it does not occlude itself.
            let target = field.position + way * (at - 1e-6);
            (is_here && stands && field.covers(target)).then_some(target)
        })
    })
}
