//! The ground that robots have passed: what ideal sensors in their places would have seen.

use libm::{atan2, cos, sin};
use parry2d_f64::{bounding_volume::Aabb, glamx::DVec2};

use super::{
    plane_pose::PlanePose,
    robots::SimRobot,
    room::{CellGrid, Room},
};

/// Maximum distance from a sensor, in metres.
const NEAR: f64 = 3.0;
/// Distance in metres, or angle in radians, after which a sensor looks again.
const STEP: f64 = 0.1;
const TURN: f64 = 0.1;

/// The ground within three metres and in the line of sight of the robots' sensors.
pub(super) struct Passed {
    seen: Vec<bool>,
    looked: Vec<Option<PlanePose>>,
}

impl Passed {
    pub(super) fn new(cells: CellGrid, robots: usize) -> Self {
        Self { seen: vec![false; cells.count()], looked: vec![None; robots] }
    }

    /// Marks the ground that a robot's sensor sees, as really mounted.
    pub(super) fn look(&mut self, index: usize, robot: &SimRobot, room: &Room, cells: CellGrid) {
        let pose = robot.pose();
        let moved = |last: &PlanePose| {
            last.position.distance(pose.position) >= STEP
                || (last.heading - pose.heading).abs() >= TURN
        };
        if !self.looked[index].as_ref().is_none_or(moved) {
            return;
        }
        self.looked[index] = Some(pose);
        let (eye, axis, half) = robot.sensor().view(pose);
        let reach = DVec2::splat(NEAR);
        let facing = DVec2::new(cos(axis), sin(axis));
        for cell in cells.within(&Aabb::new(eye - reach, eye + reach)) {
            let Some(index) = cells.index(cell).filter(|&index| !self.seen[index]) else {
                continue;
            };
            let way = cells.centre(cell) - eye;
            let aside = atan2(facing.perp_dot(way), facing.dot(way));
            let height = robot.sensor().height_m();
            self.seen[index] = way.length() <= NEAR
                && aside.abs() <= half
                && room.sees(eye.extend(height), cells.centre(cell).extend(height));
        }
    }

    /// The cells whose centres have been seen; centres of solid cells never are.
    pub(super) fn cells(&self, cells: CellGrid) -> impl Iterator<Item = (i32, i32)> {
        let seen = self.seen.iter().enumerate().filter(|(_, seen)| **seen);
        seen.map(move |(index, _)| cells.cell(index))
    }
}
