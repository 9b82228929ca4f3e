//! Compares what cameras see with a step-by-step ray to each cell.

use std::f64::consts::TAU;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_protocol::tile::Cell;

use super::super::{
    camera::{CameraModel, Candidate, Projection},
    coverage::coverage,
    floor_plan::{Enclosure, FloorPlan, FloorPlanError},
    obstacle::{Obstacle, Outline},
};
use crate::grid::OccupancyGrid;

const MODEL: CameraModel =
    CameraModel { horizontal_fov_deg: 87.0, vertical_fov_deg: 58.0, range_m: 7.0 };
/// Steps of a ray, in metres.
const STEP: f64 = 0.002;

/// A room of 9 x 7 m with boxes, discs and triangles of all heights, some of which hang.
fn furnished(seed: u64) -> (FloorPlan, Vec<Obstacle>) {
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    let obstacles: Vec<Obstacle> = (0..12)
        .map(|number| {
            let centre = [dice.random_range(0.0..9.0), dice.random_range(0.0..7.0)];
            let radius = dice.random_range(0.1..0.8);
            let corners = |count: usize, turn: f64| {
                let corner = |index: usize| {
                    let angle = turn + index as f64 / count as f64 * TAU;
                    [centre[0] + radius * angle.cos(), centre[1] + radius * angle.sin()]
                };
                Outline::Polygon((0..count).map(corner).collect())
            };
            let outline = match number % 3 {
                0 => Outline::Disc { centre_m: centre, radius_m: radius },
                kind => corners(kind + 2, dice.random_range(0.0..TAU)),
            };
            let bottom_m = if number % 4 == 0 { dice.random_range(0.4..1.5) } else { 0.0 };
            Obstacle { outline, bottom_m, top_m: bottom_m + dice.random_range(0.1..1.5) }
        })
        .collect();
    let outline = vec![[0.0, 0.0], [9.0, 0.0], [9.0, 7.0], [0.0, 7.0]];
    let enclosure = Enclosure::Outline(outline);
    (FloorPlan::new(enclosure, obstacles.clone(), [3.0, 0.3], 0.5).unwrap(), obstacles)
}

/// A map of 8 x 6 m, 0.1 m a cell, with walls drawn at random.
fn walled(seed: u64) -> (FloorPlan, OccupancyGrid) {
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    let mut map = OccupancyGrid::new(0.1, [-1.0, 2.5], 80, 60).unwrap();
    for row in 0..60 {
        (0..80).for_each(|column| map.set(column, row, Cell::Free));
    }
    for _ in 0..8 {
        let (column, row) = (dice.random_range(0..70usize), dice.random_range(0..50usize));
        let length = dice.random_range(3..25usize);
        let is_level = dice.random_range(0..2) == 0;
        for step in 0..length {
            let (x, y) = if is_level { (column + step, row) } else { (column, row + step) };
            map.set(x, y, Cell::Occupied);
        }
    }
    let plan = FloorPlan::new(Enclosure::Map(map.clone()), vec![], [f64::INFINITY, 0.3], 0.5);
    (plan.unwrap(), map)
}

/// Random cameras of a room, most of which look at its floor.
fn cameras(plan: &FloorPlan, height: f64, seed: u64) -> Vec<Candidate> {
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    let mounts = plan.mounts(0.7, height);
    (0..40)
        .map(|_| {
            let [x, y] = mounts[dice.random_range(0..mounts.len())];
            Candidate {
                position_m: [x, y, height],
                heading_deg: dice.random_range(0.0..360.0),
                tilt_deg: dice.random_range(20.0..90.0),
            }
        })
        .collect()
}

/// The position of a floor point in the image of a camera, as multiples of half the width and
/// height. Computed by rotating the line of sight, not by projecting it onto axes.
fn in_image(camera: &Candidate, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
    let [from_x, from_y, height] = camera.position_m;
    let (dx, dy) = (x - from_x, y - from_y);
    // Turn about z until the camera faces along x, then about y until it is level.
    let heading = -camera.heading_deg.to_radians();
    let ahead = dx * heading.cos() - dy * heading.sin();
    let left = dx * heading.sin() + dy * heading.cos();
    let tilt = camera.tilt_deg.to_radians();
    let depth = ahead * tilt.cos() + height * tilt.sin();
    let up = ahead * tilt.sin() - height * tilt.cos();
    let half = |degrees: f64| (degrees.to_radians() / 2.0).tan();
    (depth > 0.0).then(|| {
        [left / depth / half(MODEL.horizontal_fov_deg), up / depth / half(MODEL.vertical_fov_deg)]
    })
}

/// Whether a camera sees a point of the floor. `is_solid` says whether a point in space is inside
/// an obstacle that is enlarged by a margin. `None` if a small margin changes the answer.
fn sees(
    camera: &Candidate,
    floor: [f64; 2],
    is_solid: impl Fn([f64; 3], f64) -> bool,
) -> Option<bool> {
    let [x, y, height] = camera.position_m;
    let length = ((floor[0] - x).powi(2) + (floor[1] - y).powi(2) + height * height).sqrt();
    let image = in_image(camera, floor);
    let edge = image.map_or(f64::INFINITY, |[u, v]| u.abs().max(v.abs()));
    if (edge - 1.0).abs() < 1e-6 || (length - MODEL.range_m).abs() < 1e-6 {
        return None;
    }
    if edge > 1.0 || length > MODEL.range_m {
        return Some(false);
    }
    let steps = (length / STEP) as usize;
    let is_hidden = |margin: f64| {
        (0..steps).any(|step| {
            let part = step as f64 / steps as f64;
            let at = [x + part * (floor[0] - x), y + part * (floor[1] - y), height * (1.0 - part)];
            is_solid(at, margin)
        })
    };
    let (thin, thick) = (is_hidden(-0.01), is_hidden(0.01));
    (thin == thick).then_some(!thick)
}

/// Whether a point is within an obstacle that is enlarged by a margin on all sides.
fn is_in(obstacle: &Obstacle, [x, y, z]: [f64; 3], margin: f64) -> bool {
    if z < obstacle.bottom_m - margin || z > obstacle.top_m + margin {
        return false;
    }
    match &obstacle.outline {
        Outline::Disc { centre_m, radius_m } => {
            (x - centre_m[0]).hypot(y - centre_m[1]) < radius_m + margin
        }
        Outline::Polygon(corners) => {
            // Signed distances from the edges; inside of all edges they are positive.
            let next = corners.iter().cycle().skip(1);
            corners.iter().zip(next).all(|(from, to)| {
                let (along_x, along_y) = (to[0] - from[0], to[1] - from[1]);
                let inward = along_x * (y - from[1]) - along_y * (x - from[0]);
                inward / along_x.hypot(along_y) > -margin
            })
        }
    }
}

/// Compares the coverage of cameras with that of step-by-step rays. Returns the numbers of cells
/// that are seen, hidden, and too close to decide.
fn compare(
    plan: &FloorPlan,
    cameras: &[Candidate],
    is_solid: impl Fn([f64; 3], f64) -> bool,
) -> [usize; 3] {
    let covers = coverage(plan, Projection::Pinhole, &MODEL, cameras);
    let mut counts = [0; 3];
    for (camera, covered) in cameras.iter().zip(covers.iter()) {
        for (cell, place) in plan.cells().iter().enumerate() {
            let Some(truth) = sees(camera, place.aim_m, &is_solid) else {
                counts[2] += 1;
                continue;
            };
            let claim = covered.binary_search(&(cell as u32)).is_ok();
            assert_eq!(claim, truth, "{camera:?} and {place:?}");
            counts[usize::from(!truth)] += 1;
        }
    }
    counts
}

#[test]
#[ignore = "long: cargo thorough"]
fn furniture_hides_what_is_behind_it() {
    let mut all = [0; 3];
    for seed in 0..6 {
        let (plan, obstacles) = furnished(seed);
        let cameras = cameras(&plan, 2.8, seed);
        let is_solid = |at, margin| obstacles.iter().any(|it| is_in(it, at, margin));
        let counts = compare(&plan, &cameras, is_solid);
        (0..3).for_each(|index| all[index] += counts[index]);
    }
    let [seen, unseen, close] = all;
    assert!(seen > 5_000 && unseen > 5_000, "{all:?}");
    assert!(close < (seen + unseen) / 10, "{all:?}");
}

#[test]
fn walls_of_a_map_hide_what_is_behind_them() {
    let mut all = [0; 3];
    for seed in 0..6 {
        let (plan, map) = walled(seed);
        let cameras = cameras(&plan, 3.0, seed);
        // The squares within a margin of a point; for a negative one, the square far from whose edge
        // the point is.
        let is_solid = |[x, y, _]: [f64; 3], margin: f64| {
            let corners = [-margin, margin].map(|dx| [-margin, margin].map(|dy| [x + dx, y + dy]));
            let mut hits = corners.iter().flatten().map(|&corner| {
                let [column, row] = map.from_map(corner);
                column >= 0.0
                    && row >= 0.0
                    && map.cell(column as usize, row as usize) == Cell::Occupied
            });
            if margin > 0.0 { hits.any(|hit| hit) } else { hits.all(|hit| hit) }
        };
        let counts = compare(&plan, &cameras, is_solid);
        (0..3).for_each(|index| all[index] += counts[index]);
    }
    let [seen, unseen, close] = all;
    assert!(seen > 3_000 && unseen > 5_000, "{all:?}");
    assert!(close < (seen + unseen) / 10, "{all:?}");
}

#[test]
fn the_papers_model_ignores_obstacles() {
    let (plan, _) = furnished(3);
    let empty = Enclosure::Outline(vec![[0.0, 0.0], [9.0, 0.0], [9.0, 7.0], [0.0, 7.0]]);
    let empty = FloorPlan::new(empty, vec![], [3.0, 0.3], 0.5).unwrap();
    let camera = [Candidate { position_m: [4.5, 3.5, 2.8], heading_deg: 0.0, tilt_deg: 90.0 }];
    let covered = |plan: &FloorPlan| {
        let covers = coverage(plan, Projection::Paper, &MODEL, &camera);
        let aims = covers.row(0).iter().map(|&cell| plan.cells()[cell as usize].aim_m);
        aims.collect::<Vec<_>>()
    };
    // 2.8 tan(29 deg) = 1.552 m ahead and behind, 2.8 tan(43.5 deg) = 2.657 m to each side.
    let inside = |[x, y]: [f64; 2]| (x - 4.5).abs() <= 1.552 && (y - 3.5).abs() <= 2.657;
    for plan in [&plan, &empty] {
        let expected = plan.cells().iter().filter(|cell| inside(cell.aim_m)).count();
        assert_eq!(covered(plan).len(), expected);
        assert!(covered(plan).into_iter().all(inside));
    }
    assert_eq!(covered(&empty).len(), 6 * 10);
}

#[test]
fn the_floor_is_free_and_inside_the_outline() {
    let rectangle = |west: f64, south: f64, east: f64, north: f64| {
        vec![[west, south], [east, south], [east, north], [west, north]]
    };
    let obstacle = |corners: Vec<[f64; 2]>, bottom_m: f64| Obstacle {
        outline: Outline::Polygon(corners),
        bottom_m,
        top_m: bottom_m + 0.5,
    };
    let room = Enclosure::Outline(rectangle(0.0, 0.0, 10.0, 8.0));
    let plan = |obstacles| FloorPlan::new(room.clone(), obstacles, [3.0, 0.3], 0.5);
    let empty = plan(vec![]).unwrap();
    assert_eq!((empty.cells().len(), empty.size()), (320, [20, 16]));
    assert_eq!(empty.cells()[21].aim_m, [0.75, 0.75]);
    assert_eq!(empty.cell_at(1, 1), Some(21));
    // A chest of 1 x 2 m covers eight cells; a table over the same cells leaves them floor.
    assert_eq!(
        plan(vec![obstacle(rectangle(2.0, 2.0, 3.0, 4.0), 0.0)]).unwrap().cells().len(),
        312
    );
    assert_eq!(
        plan(vec![obstacle(rectangle(2.0, 2.0, 3.0, 4.0), 0.7)]).unwrap().cells().len(),
        320
    );
    // A cell that is half free is floor, and its aim point is in the free half.
    let half = plan(vec![obstacle(rectangle(2.0, 2.0, 2.24, 2.5), 0.0)]).unwrap();
    assert_eq!(half.cells().len(), 320);
    let aim = half.cells()[half.cell_at(4, 4).unwrap()].aim_m;
    assert!(aim[0] > 2.24 && aim[0] < 2.5, "{aim:?}");
    // A piece of two cells behind a wall is left out.
    let walls = vec![
        obstacle(rectangle(8.4, 7.4, 9.0, 8.0), 0.0),
        obstacle(rectangle(9.0, 7.0, 10.0, 7.5), 0.0),
    ];
    let cut = plan(walls).unwrap();
    assert_eq!(cut.left_out(), 2);
    assert_eq!(cut.cell_at(19, 15), None);
    let full = plan(vec![obstacle(rectangle(-1.0, -1.0, 11.0, 9.0), 0.0)]);
    assert!(matches!(full, Err(FloorPlanError::NoFloor { .. })));
    let vast = Enclosure::Outline(rectangle(0.0, 0.0, 1e6, 1e6));
    let vast = FloorPlan::new(vast, vec![], [3.0, 0.3], 0.5);
    assert!(matches!(vast, Err(FloorPlanError::TooLarge { .. })));
}

#[test]
fn cameras_hang_only_in_free_space() {
    let (plan, obstacles) = furnished(1);
    for height in [0.5, 1.2, 2.8] {
        let mounts = plan.mounts(0.5, height);
        assert!(mounts.len() > 200);
        for [x, y] in mounts {
            assert!(!obstacles.iter().any(|it| is_in(it, [x, y, height], -0.001)));
        }
    }
    assert!(plan.mounts(0.5, 3.1).is_empty());
    assert_eq!(plan.mounts(1.0, 2.95).len(), 63);
    assert_eq!(plan.mounts(1.0, 2.95)[1], [1.5, 0.5]);
}
