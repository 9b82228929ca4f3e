//! Compares the planner with the exact shortest path: Dijkstra over all pairs of mutually visible
//! cells, in double precision.

use std::{vec, vec::Vec};

use proptest::prelude::*;
use ubimap_protocol::{
    tile::Row,
    units::{Millimetres, Pose},
};

use super::*;

const CELL: i32 = 50;

/// Rooms: rectangular walls with doors.
#[derive(Clone, Debug)]
struct Rooms {
    /// Column or row of the wall, its first and last cell, the first cell and the width of its
    /// door; whether the wall is vertical.
    walls: Vec<(i32, i32, i32, i32, i32, bool)>,
    /// Boxes: column, row, width, height.
    boxes: Vec<(i32, i32, i32, i32)>,
}

impl Rooms {
    fn is_wall(&self, x: i32, y: i32) -> bool {
        let in_wall = self.walls.iter().any(|&(at, from, to, door, width, vertical)| {
            let (across, along) = if vertical { (x, y) } else { (y, x) };
            across == at && (from..=to).contains(&along) && !(door..door + width).contains(&along)
        });
        let in_box = |&(at_x, at_y, width, height): &(i32, i32, i32, i32)| {
            (at_x..at_x + width).contains(&x) && (at_y..at_y + height).contains(&y)
        };
        in_wall || self.boxes.iter().any(in_box)
    }

    fn row(&self, column: i32, row: i32) -> GroundRow {
        let mut cells = Row::default();
        for bit in 0..32 {
            let plane =
                if self.is_wall(column * 32 + bit, row) { &mut cells.high } else { &mut cells.low };
            *plane |= 1 << bit;
        }
        GroundRow { cells, covered: 0 }
    }

    /// A window whose corner is cell (0, 0).
    fn window(&self, radius: u16) -> PlanningWindow {
        let middle = Millimetres(32 * CELL);
        let pose = Pose { x: middle, y: middle, ..Pose::default() };
        let near = NearPoints::default();
        let view = WindowInputs {
            pose,
            resolution: Millimetres(CELL),
            level: 0,
            radius,
            near: &near,
            movers: &[],
            given_up: &[],
            explore_covered: true,
        };
        let mut window = PlanningWindow::EMPTY;
        window.fill(&view, |column, row| self.row(column, row));
        window
    }
}

fn rooms() -> impl Strategy<Value = Rooms> {
    let wall = (0..64i32, 0..40i32, 20..64i32, 0..60i32, 6..16i32, any::<bool>());
    let block = (0..60i32, 0..60i32, 1..9i32, 1..9i32);
    (prop::collection::vec(wall, 0..5), prop::collection::vec(block, 0..10))
        .prop_map(|(walls, boxes)| Rooms { walls, boxes })
}

fn place(index: usize) -> Place {
    Place { x: (index % SIDE) as u8, y: (index / SIDE) as u8 }
}

fn between(a: Place, b: Place) -> f64 {
    f64::from(a.x.abs_diff(b.x)).hypot(f64::from(a.y.abs_diff(b.y)))
}

/// Whether the line between two cell centres touches only free cells: an independent formulation
/// that clips the line to each cell.
fn sees(window: &PlanningWindow, a: Place, b: Place) -> bool {
    let ((ax, ay), (bx, by)) = (a.column_and_row(), b.column_and_row());
    let range = |p: i32, q: i32| p.min(q)..=p.max(q);
    range(ay, by).all(|y| {
        range(ax, bx).all(|x| {
            // The part of the line, from 0 at its start to 1 at its end, that lies between two
            // opposite sides of the cell.
            let span = |from: i32, to: i32, at: i32| {
                let way = f64::from(to - from);
                if way == 0.0 {
                    return (0.0, 1.0);
                }
                let (p, q) = (f64::from(2 * (at - from) - 1), f64::from(2 * (at - from) + 1));
                let (p, q) = (p / (2.0 * way), q / (2.0 * way));
                (p.min(q).max(0.0), p.max(q).min(1.0))
            };
            let (x_span, y_span) = (span(ax, bx, x), span(ay, by, y));
            let touches = x_span.1.min(y_span.1) - x_span.0.max(y_span.0) > -1e-9;
            !touches || window.free.has(Place { x: x as u8, y: y as u8 })
        })
    })
}

/// The exact length of the shortest path in cells, which must be at most `most`.
fn shortest(window: &PlanningWindow, start: Place, goal: Place, most: f64) -> f64 {
    let free = (0..SIDE * SIDE).map(place).filter(|&it| window.free.has(it));
    let nodes = free.filter(|&it| between(start, it) + between(it, goal) <= most + 1e-9);
    let nodes = nodes.collect::<Vec<_>>();
    let mut way = vec![f64::INFINITY; nodes.len()];
    let mut open = vec![true; nodes.len()];
    way[nodes.iter().position(|&it| it == start).unwrap()] = 0.0;
    loop {
        let promise = |at: usize| way[at] + between(nodes[at], goal);
        let ahead = (0..nodes.len()).filter(|&at| open[at]);
        let at = ahead.min_by(|&a, &b| promise(a).total_cmp(&promise(b))).unwrap();
        if nodes[at] == goal {
            return way[at];
        }
        open[at] = false;
        for to in 0..nodes.len() {
            let length = way[at] + between(nodes[at], nodes[to]);
            if open[to] && length < way[to] && window.sees(nodes[at], nodes[to]) {
                way[to] = length;
            }
        }
    }
}

/// Whether steps between 4-neighbours connect two cells.
fn is_reachable(window: &PlanningWindow, start: Place, goal: Place) -> bool {
    let mut found = Plane::EMPTY;
    let mut todo = vec![start];
    while let Some(at) = todo.pop() {
        let (x, y) = at.column_and_row();
        for (dx, dy) in [(1, 0), (0, 1), (-1, 0), (0, -1)] {
            let next = Place::new(x + dx, y + dy);
            if let Some(next) = next.filter(|&it| window.free.has(it) && !found.has(it)) {
                found.insert(next);
                todo.push(next);
            }
        }
    }
    start == goal || found.has(goal)
}

fn plan(window: &PlanningWindow, start: Place, target: Target) -> Result<Path, PlanError> {
    let mut planner = std::boxed::Box::new(Planner::EMPTY);
    planner.begin(window, start, target)?;
    for _ in 0..SIDE * SIDE {
        match planner.step(window, 70) {
            Progress::Searching => {}
            Progress::Found(_) => return Ok(planner.path()),
            Progress::Failed(error) => return Err(error),
        }
    }
    panic!("the search does not end");
}

fn length(path: &Path) -> f64 {
    path.places.windows(2).map(|pair| between(pair[0], pair[1])).sum()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn a_path_is_clear_and_within_3_percent_of_the_shortest(
        rooms in rooms(), radius in prop::sample::select(vec![0u16, 100, 180]),
        start in 0..4096usize, goal in 0..4096usize,
    ) {
        let window = rooms.window(radius);
        let (start, goal) = (place(start), place(goal));
        prop_assume!(window.free.has(start) && window.free.has(goal));
        let reachable = is_reachable(&window, start, goal);
        match plan(&window, start, Target::Place(goal)) {
            Err(error) => prop_assert!(error == PlanError::Unreachable && !reachable),
            Ok(path) => {
                prop_assert!(path.is_whole);
                prop_assert_eq!(path.places.first().copied(), Some(start));
                prop_assert_eq!(path.places.last().copied(), Some(goal));
                for pair in path.places.windows(2) {
                    prop_assert!(sees(&window, pair[0], pair[1]));
                }
                let found = length(&path);
                let best = shortest(&window, start, goal, found);
                prop_assert!(found >= best - 1e-9, "{found} < {best}");
                prop_assert!(found <= 1.03 * best, "{} of {best}", found / best);
            }
        }
    }

    #[test]
    fn lines_of_sight_match_the_geometry(
        rooms in rooms(), start in 0..4096usize, goal in 0..4096usize,
    ) {
        let window = rooms.window(0);
        let (start, goal) = (place(start), place(goal));
        prop_assume!(window.free.has(start));
        prop_assert_eq!(window.sees(start, goal), sees(&window, start, goal));
    }

    #[test]
    fn every_point_of_a_free_cell_is_clear_of_every_wall(
        rooms in rooms(), radius in 0u16..600, x in 1..63i32, y in 1..63i32,
        inside in (0.0f64..=1.0, 0.0f64..=1.0),
    ) {
        let window = rooms.window(radius);
        // Cells under the robot are excluded: the window clears the walls there.
        let away = f64::from(x - 32).hypot(f64::from(y - 32)) * f64::from(CELL);
        prop_assume!(away > 2.0 * f64::from(radius) + 200.0);
        let is_free = window.free.has(Place { x: x as u8, y: y as u8 });
        let (at_x, at_y) = (f64::from(x) + inside.0, f64::from(y) + inside.1);
        let walls = (0..64).flat_map(|y| (0..64).map(move |x| (x, y)));
        let walls = walls.filter(|&(x, y)| rooms.is_wall(x, y));
        let gap = |at: f64, cell: i32| {
            let cell = f64::from(cell);
            (cell - at).max(at - cell - 1.0).max(0.0)
        };
        let nearest = walls.map(|(x, y)| gap(at_x, x).hypot(gap(at_y, y)));
        let nearest = nearest.fold(f64::INFINITY, f64::min) * f64::from(CELL);
        if is_free {
            prop_assert!(nearest >= f64::from(radius) - 1.0, "{nearest}");
        } else {
            // A cell that is not free is farther from a wall than the radius by at most its
            // diagonal.
            prop_assert!(nearest <= f64::from(radius) + 1.42 * f64::from(CELL), "{nearest}");
        }
    }
}
