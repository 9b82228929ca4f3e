//! Runs in which the robots drive themselves: their drive configuration, and the blind ground
//! mapped.

use std::cell::Cell;

use ubimap_agent::drive::{DriveCommand, Driving, Gaze, Motion, SafetyLimits};
use ubimap_protocol::{
    tile::{Cell as MapCell, TILE_SIDE, TileId},
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

use super::{fleet::Fleet, options::MotionName, scoring};
use crate::{
    camera::FrameSource,
    grid::OccupancyGrid,
    mapping::ServedLayer,
    report::DrivingSummary,
    server::coordination::Settings,
    world::{SimRobot, World},
};

/// Minimum clearance of a robot, in millimetres.
const MARGIN: u16 = 30;
/// Time for a turn on the spot, until the server has received the result.
const LOOK: Duration = Duration::from_secs(7);
/// Maximum distance at which a robot views a frontier, in metres.
const VIEW_M: f64 = 2.5;
/// Radius that a robot looks at where its path ends, in metres: beyond the frontier.
const AROUND_M: f64 = VIEW_M + 0.3;
/// Clearance that counts as passable, in metres: half a diagonal of two cells, the width of a wall
/// in the map.
const ROOM_M: f64 = 0.065;
/// Share of the blind ground that counts as completely mapped.
const ALL: f64 = 0.99;
/// Interval between two checks of that share.
const INTERVAL: Duration = Duration::from_secs(1);

/// The coordinator's settings for the robots of a world.
pub(super) fn coordination(world: &World) -> Settings {
    let ranges = world.robots().iter().map(|robot| robot.sensor().max_range_m());
    let range_m = ranges.fold(f64::INFINITY, f64::min);
    let view_m = range_m.min(VIEW_M);
    Settings { view_m, range_m, look: LOOK, ..Settings::default() }
}

/// The drive configuration of a simulated robot; `None` if it has no route and never drives.
pub(super) fn driving(robot: &SimRobot, motion: MotionName) -> Option<Driving> {
    robot
        .drives()
        .then(|| Driving { stop_and_wait: motion == MotionName::StopAndWait, ..usual(robot) })
}

fn usual(robot: &SimRobot) -> Driving {
    let [speed, turn, acceleration] = robot.limits();
    let usual = Motion::default();
    let motion = Motion {
        radius: (robot.radius_m() * 1_000.0).ceil() as u16,
        margin: MARGIN,
        top_speed: (speed * 1_000.0) as f32,
        top_turn: turn as f32,
        acceleration: (acceleration * 1_000.0) as f32,
        ..usual
    };
    let safety = SafetyLimits { silence: Some(Duration::from_secs(3)), ..SafetyLimits::default() };
    let sensor = robot.sensor();
    let gaze = Gaze {
        half_view: -sensor.first_angle_rad() as f32,
        reach: (sensor.max_range_m().min(AROUND_M) * 1_000.0) as u16,
        radius: motion.radius,
    };
    let looks_at_goal = Some(gaze);
    Driving { motion, safety, looks_at_goal, ..Driving::default() }
}

/// A command as speed in m/s and turn rate in rad/s.
pub(super) fn wheels(command: DriveCommand) -> (f64, f64) {
    (f64::from(command.speed) / 1_000.0, f64::from(command.turn) / 1_000.0)
}

/// The ground that a robot can reach but no camera sees, and when it was mapped. On a floor plan, only
/// ground that the plan knows as free: robots may fit through a gap of its walls, but what lies beyond is
/// nobody's task.
pub(super) struct BlindGround {
    cells: Vec<(i32, i32)>,
    next: Cell<Instant>,
    mapped: Cell<Option<Duration>>,
}

impl BlindGround {
    /// `side` is that of the world's cells.
    pub(super) fn of(world: &World, plan: Option<&OccupancyGrid>, side: Millimetres) -> Self {
        let side = side.metres();
        let mut covered: Vec<(i32, i32)> = (0..FrameSource::cameras(world).len())
            .flat_map(|camera| world.covered(camera))
            .collect();
        covered.sort_unstable();
        let radius = world.robots().iter().map(SimRobot::radius_m).fold(0.0, f64::max);
        let mut cells = world.reachable(radius, ROOM_M);
        cells.retain(|&(x, y)| {
            let corner = [f64::from(x) * side, f64::from(y) * side];
            let is_free = plan.is_none_or(|plan| plan.square(corner, side) == MapCell::Free);
            is_free && covered.binary_search(&(x, y)).is_err()
        });
        Self { cells, next: Cell::new(Instant(0)), mapped: Cell::new(None) }
    }

    /// The share that a map knows, 0 to 1.
    fn known(&self, fused: &ServedLayer) -> f64 {
        let within = |cell: i32| cell.rem_euclid(TILE_SIDE as i32) as usize;
        let is_known = |&&(x, y): &&(i32, i32)| {
            let tile = TileId::of_cell(x, y).and_then(|id| fused.get(id));
            tile.is_some_and(|(_, tile)| tile.cell(within(x), within(y)) != MapCell::Unknown)
        };
        if self.cells.is_empty() {
            return 1.0;
        }
        self.cells.iter().filter(is_known).count() as f64 / self.cells.len() as f64
    }

    /// Notes the time when all of it is mapped. Checks once per [`INTERVAL`].
    pub(super) fn look(&self, fleet: &Fleet<'_>) {
        let now = fleet.now();
        if self.mapped.get().is_none() && now >= self.next.get() {
            self.next.set(now + INTERVAL);
            if self.known(fleet.server().fused()) >= ALL {
                self.mapped.set(Some(fleet.elapsed()));
            }
        }
    }

    /// The figures of the run.
    pub(super) fn summary(
        &self,
        fleet: &Fleet<'_>,
        world: &World,
        tracks: &[Vec<Pose>],
    ) -> DrivingSummary {
        let (contacts, resolution) = (world.contacts(), fleet.deployment().resolution());
        let until = self.mapped.get().unwrap_or(fleet.elapsed());
        let stood = scoring::longest_stand(tracks, world.robots(), until);
        DrivingSummary {
            collisions: contacts.collisions,
            touches: contacts.touches,
            blind_m2: self.cells.len() as f64 * resolution.metres().powi(2),
            blind_mapped: self.known(fleet.server().fused()),
            mapped_s: self.mapped.get().map(|it| it.micros() as f64 / 1e6),
            stood_s: stood.micros() as f64 / 1e6,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{Scenario, WallGrid};

    /// A room of 7.8 x 3.8 m with a gap of a metre in its northern wall, in a plan that knows nothing beyond
    /// its walls.
    #[test]
    fn what_a_plan_does_not_know_is_no_ground_to_be_mapped() {
        let (width, height, north) = (160, 140, 79);
        let mut plan = OccupancyGrid::new(0.05, [-1.0, 2.0], width, height).unwrap();
        for (column, row) in (0..=north).flat_map(|row| (0..width).map(move |x| (x, row))) {
            let is_edge = [0, 1, width - 2, width - 1].contains(&column) || [0, 1].contains(&row);
            let is_gap = (60..80).contains(&column);
            let is_wall = is_edge || row + 1 >= north && !is_gap;
            plan.set(column, row, if is_wall { MapCell::Occupied } else { MapCell::Free });
        }
        let walls = WallGrid {
            resolution_m: 0.05,
            origin_m: plan.origin_m(),
            width,
            height,
            occupied: plan.cells().iter().map(|cell| *cell == MapCell::Occupied).collect(),
        };
        let free: Vec<bool> = plan.cells().iter().map(|cell| *cell == MapCell::Free).collect();
        let mut scenario =
            Scenario::read_with("office".as_ref(), Some("office.yaml".as_ref())).unwrap();
        let grow = scenario.grow.as_mut().unwrap();
        (grow.robots, grow.cameras, grow.people) = (2, 0, 0);
        scenario.grow_in(&walls, &free).unwrap();
        let side = Millimetres(50);
        let world = World::new(&scenario, Some(&walls), side, 1).unwrap();
        let m2 = |ground: &BlindGround| ground.cells.len() as f64 * 0.05 * 0.05;
        let (all, inside) =
            (BlindGround::of(&world, None, side), BlindGround::of(&world, Some(&plan), side));
        assert!(m2(&all) > 50.0, "the robots fit through the gap: {}", m2(&all));
        // Robots keep off the walls, and round ones out of the corners.
        let room = 7.8 * 3.8;
        assert!((room - 3.0..room).contains(&m2(&inside)), "{}", m2(&inside));
    }
}
