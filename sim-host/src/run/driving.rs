//! Runs in which the robots drive themselves: their drive configuration, and the blind ground
//! mapped.

use std::cell::Cell;

use ubimap_agent::drive::{DriveCommand, Driving, Gaze, Motion, SafetyLimits};
use ubimap_protocol::{
    tile::{Cell as MapCell, TILE_SIDE, TileId},
    time::{Duration, Instant},
};

use super::{fleet::Fleet, options::MotionName};
use crate::{
    camera::FrameSource,
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

/// The ground that a robot can reach but no camera sees, and when it was mapped.
pub(super) struct BlindGround {
    cells: Vec<(i32, i32)>,
    next: Cell<Instant>,
    mapped: Cell<Option<Duration>>,
}

impl BlindGround {
    pub(super) fn of(world: &World) -> Self {
        let mut covered: Vec<(i32, i32)> = (0..FrameSource::cameras(world).len())
            .flat_map(|camera| world.covered(camera))
            .collect();
        covered.sort_unstable();
        let radius = world.robots().iter().map(SimRobot::radius_m).fold(0.0, f64::max);
        let mut cells = world.reachable(radius, ROOM_M);
        cells.retain(|cell| covered.binary_search(cell).is_err());
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
    pub(super) fn summary(&self, fleet: &Fleet<'_>, world: &World) -> DrivingSummary {
        let (contacts, resolution) = (world.contacts(), fleet.deployment().resolution());
        DrivingSummary {
            collisions: contacts.collisions,
            touches: contacts.touches,
            blind_m2: self.cells.len() as f64 * resolution.metres().powi(2),
            blind_mapped: self.known(fleet.server().fused()),
            mapped_s: self.mapped.get().map(|it| it.micros() as f64 / 1e6),
        }
    }
}
