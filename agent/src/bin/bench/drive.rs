//! Instruction counts of driving: a window of the map, paths across it, and a step along one.

use core::hint::black_box;

use cortex_m::singleton;
use ubimap_agent::{
    drive::{
        Follower, GroundRow, MAX_POINTS, Motion, Mover, NearPoints, Place, PlanError, Planner,
        PlanningWindow, Progress, SIDE, Seen, Sight, Target, WindowInputs,
    },
    sense::{Beam, SensorModel, Validity, fill_beams},
};
use ubimap_protocol::{
    tile::Row,
    time::Instant,
    units::{Millimetres, Pose},
};

use super::{counter::Bench, planes::BOUNDS};

/// Rooms of 64 x 64 cells, which a robot 30 cm wide crosses from corner to corner.
#[derive(Clone, Copy, PartialEq)]
enum Scene {
    /// Empty.
    Empty,
    /// Three rooms, with doors of 80 cm on opposite sides.
    Rooms,
    /// Tables and boxes.
    Furniture,
    /// Walls from alternate sides: the longest path possible.
    Serpent,
    /// A wall without a door.
    Closed,
}

/// The tables and boxes of [`Scene::Furniture`]: column, row, width and height in cells.
const FURNITURE: [(i32, i32, i32, i32); 10] = [
    (12, 2, 6, 12),
    (24, 10, 8, 6),
    (10, 20, 10, 5),
    (28, 24, 5, 14),
    (40, 2, 8, 16),
    (44, 28, 12, 5),
    (12, 34, 8, 10),
    (26, 46, 14, 6),
    (46, 42, 6, 12),
    (8, 52, 8, 6),
];

impl Scene {
    fn is_wall(self, x: i32, y: i32) -> bool {
        match self {
            Self::Empty => false,
            Self::Rooms => x == 21 && !(44..60).contains(&y) || x == 42 && !(4..20).contains(&y),
            Self::Furniture => {
                let is_in = |&(left, bottom, width, height): &(i32, i32, i32, i32)| {
                    (left..left + width).contains(&x) && (bottom..bottom + height).contains(&y)
                };
                FURNITURE.iter().any(is_in)
            }
            Self::Serpent => (y + 2) % 12 == 0 && if y / 12 % 2 == 0 { x < 52 } else { x >= 12 },
            Self::Closed => x == 32,
        }
    }

    fn row(self, column: i32, row: i32) -> GroundRow {
        let mut cells = Row::default();
        for bit in 0..32 {
            let x = column * 32 + bit;
            let inside = (0..SIDE as i32).contains(&x) && (0..SIDE as i32).contains(&row);
            let wall = !inside || self.is_wall(x, row);
            *(if wall { &mut cells.high } else { &mut cells.low }) |= 1 << bit;
        }
        GroundRow { cells, covered: u32::MAX }
    }
}

/// Plans across each scene, then makes steps along a path. `None` if any result is wrong.
#[inline(never)]
pub(super) fn run(bench: &mut Bench) -> Option<()> {
    let planner = singleton!(: Planner = Planner::EMPTY)?;
    let window = singleton!(: PlanningWindow = PlanningWindow::EMPTY)?;
    let size = size_of::<Planner>() + size_of::<PlanningWindow>();
    cortex_m_semihosting::hprintln!("{:>12}  bytes of a planner and its window", size);
    let (start, goal) = (Place { x: 5, y: 5 }, Place { x: 58, y: 58 });
    for (name, scene) in [
        ("an empty room", Scene::Empty),
        ("three rooms", Scene::Rooms),
        ("furniture", Scene::Furniture),
        ("a serpent", Scene::Serpent),
    ] {
        fill(scene, window);
        let name = format_args!("a plan across a window: {name}");
        let points = bench.measure(name, || plan(planner, window, start, Target::Place(goal)));
        let (corners, expanded) = planner.corners();
        cortex_m_semihosting::hprintln!("{:>12}  corners, of which {} expanded", corners, expanded);
        points.ok().filter(|&points| points >= 2)?;
    }
    fill(Scene::Closed, window);
    let closed = bench
        .measure("no plan: a closed door", || plan(planner, window, start, Target::Place(goal)));
    (closed == Err(PlanError::Unreachable)).then_some(())?;
    follow(bench, window)
}

/// The window of a scene, with its south-western corner at the map's origin.
fn fill(scene: Scene, window: &mut PlanningWindow) {
    let near = NearPoints::default();
    let middle = Millimetres(SIDE as i32 / 2 * BOUNDS.resolution.0);
    let view = WindowInputs {
        pose: Pose { x: middle, y: middle, ..Pose::default() },
        resolution: BOUNDS.resolution,
        level: 0,
        radius: 150,
        near: &near,
        movers: &[],
        given_up: &[],
        explore_covered: false,
    };
    window.fill(&view, |column, row| scene.row(column, row));
}

/// Plans a path. Returns the number of its points.
fn plan(
    planner: &mut Planner,
    window: &mut PlanningWindow,
    start: Place,
    target: Target,
) -> Result<usize, PlanError> {
    planner.begin(window, black_box(start), target)?;
    loop {
        match planner.step(window, 1_000) {
            Progress::Searching => {}
            Progress::Found(_) => return Ok(planner.path().places.len()),
            Progress::Failed(error) => return Err(error),
        }
    }
}

/// A step in the middle of a curve, with obstacles all around and people nearby.
fn follow(bench: &mut Bench, window: &mut PlanningWindow) -> Option<()> {
    fill(Scene::Empty, window);
    let mut beams = [Beam::default(); MAX_POINTS];
    let model = SensorModel::Radial { first: -3.1, step: 6.2 / 64.0 };
    fill_beams(&mut beams, model, Pose::default());
    let near = NearPoints::of_scan(&Seen {
        taken: Instant(1),
        readings: &[450; MAX_POINTS],
        beams: &beams,
        validity: Validity::default(),
        mounting: Pose::default(),
    });
    let person = |x: i32| Mover {
        x: Millimetres(x),
        y: Millimetres(3_100),
        velocity_x: 300,
        velocity_y: 1_100,
        radius: 250,
        is_person: true,
        is_at_rest: false,
    };
    let movers: [Mover; 12] = core::array::from_fn(|index| person(1_000 + 100 * index as i32));
    let mut follower = Follower::new(Motion::default());
    let mut route = heapless::Vec::new();
    for index in 0..32u8 {
        let place = Place { x: 5 + index, y: 20 + index * index / 40 };
        route.push(window.middle(place)).ok()?;
    }
    follower.take(&route);
    let mut pose = Pose { x: Millimetres(700), y: Millimetres(1_250), ..Pose::default() };
    for _ in 0..3 {
        let sight =
            Sight { pose, unsure: 20.0, near: &near, movers: &movers, window, elapsed: 0.05 };
        bench.measure("a step along a path", || follower.step(black_box(&sight)));
        pose.x.0 += 20;
    }
    Some(())
}
