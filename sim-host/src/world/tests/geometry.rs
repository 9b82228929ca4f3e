//! Ray casting compared with ray marching in small steps.

use parry2d_f64::glamx::{DVec2, DVec3};
use proptest::prelude::*;

use super::{super::room::Room, small_room};
use crate::world::{FootprintConfig, FurnitureConfig, Scenario, WallGrid, World};

/// Step of the ray marching in metres.
const FINE: f64 = 0.002;

/// Whether a point is inside a piece of furniture, computed from its description.
fn holds(furniture: &FurnitureConfig, point: DVec3) -> bool {
    let at = point.truncate();
    (furniture.bottom_m..=furniture.top_m).contains(&point.z)
        && match &furniture.footprint {
            FootprintConfig::Box { centre_m, size_m, heading_deg } => {
                let (sine, cosine) = heading_deg.to_radians().sin_cos();
                let offset = at - DVec2::from(*centre_m);
                (offset.x * cosine + offset.y * sine).abs() <= size_m[0] / 2.0
                    && (offset.y * cosine - offset.x * sine).abs() <= size_m[1] / 2.0
            }
            FootprintConfig::Disc { centre_m, radius_m } => {
                at.distance(DVec2::from(*centre_m)) <= *radius_m
            }
            FootprintConfig::Polygon { points_m } => {
                let count = points_m.len();
                (0..count).all(|index| {
                    let (a, b) = (points_m[index], points_m[(index + 1) % count]);
                    (DVec2::from(b) - DVec2::from(a)).perp_dot(at - DVec2::from(a)) >= 0.0
                })
            }
        }
}

/// Distance along a unit direction at which ray marching enters furniture.
fn slow_hit(scenario: &Scenario, from: DVec3, along: DVec3, limit: f64) -> Option<f64> {
    (0..=(limit / FINE) as usize)
        .map(|step| step as f64 * FINE)
        .find(|&way| scenario.furniture.iter().any(|piece| holds(piece, from + along * way)))
}

fn furniture() -> impl Strategy<Value = FurnitureConfig> {
    let place = || [0.0..4.0, 0.0..3.0_f64];
    let footprint = prop_oneof![
        (place(), [0.05..1.5, 0.05..1.5_f64], -180.0..180.0).prop_map(
            |(centre_m, size_m, heading_deg)| FootprintConfig::Box {
                centre_m,
                size_m,
                heading_deg
            }
        ),
        (place(), 0.05..0.6)
            .prop_map(|(centre_m, radius_m)| FootprintConfig::Disc { centre_m, radius_m }),
        (place(), 0.1..0.8, 0.1..0.8, 0.3..0.9).prop_map(|([x, y], a, b, lean)| {
            let points_m = vec![[x - a, y - b], [x + a, y - b * lean], [x + a * lean, y + b]];
            FootprintConfig::Polygon { points_m }
        }),
    ];
    (footprint, 0.0..1.5, 0.1..1.4).prop_map(|(footprint, bottom_m, height)| FurnitureConfig {
        class: None,
        name: String::new(),
        footprint,
        bottom_m,
        top_m: bottom_m + height,
        legs_m: None,
        moved: Vec::new(),
    })
}

fn point() -> impl Strategy<Value = DVec3> {
    (0.01..3.99, 0.01..2.99, 0.0..2.9_f64).prop_map(|(x, y, z)| DVec3::new(x, y, z))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn ray_casting_agrees_with_ray_marching(
        pieces in prop::collection::vec(furniture(), 1..6),
        from in point(),
        to in point(),
        is_level in any::<bool>(),
    ) {
        let mut scenario = small_room("");
        scenario.furniture = pieces;
        let room = Room::new(&scenario, None, &[]).unwrap();
        let to = if is_level { DVec3::new(to.x, to.y, from.z) } else { to };
        let limit = from.distance(to);
        prop_assume!(limit > 0.01);
        let along = (to - from) / limit;

        let fast = room.first_hit(from, along, limit).map(|(_, way)| way);
        match (fast, slow_hit(&scenario, from, along, limit)) {
            (Some(fast), Some(slow)) => {
                prop_assert!(fast <= slow + 1e-6, "{fast} is beyond {slow}");
                // Ray marching skips corners thinner than its steps: then the fast result must lie on
                // a surface.
                let at = from + along * fast;
                let is_there = touches(&scenario, at, 1e-6);
                prop_assert!(slow - fast <= FINE + 1e-6 || is_there, "{fast}, not {slow}");
                prop_assert!(is_there, "nothing at {at}");
            }
            (Some(fast), None) => {
                let at = from + along * fast;
                prop_assert!(touches(&scenario, at, 1e-6), "nothing at {at}");
            }
            (None, Some(slow)) => prop_assert!(false, "missed what is at {slow}"),
            (None, None) => {}
        }
        prop_assert_eq!(room.sees(from, to), fast.is_none());
    }
}

/// Whether furniture is within `hair` metres of a point.
fn touches(scenario: &Scenario, point: DVec3, hair: f64) -> bool {
    let steps = [-hair, 0.0, hair];
    scenario.furniture.iter().any(|piece| {
        steps.iter().any(|&x| {
            steps.iter().any(|&y| steps.iter().any(|&z| holds(piece, point + DVec3::new(x, y, z))))
        })
    })
}

#[test]
fn walls_of_a_map_are_its_occupied_cells() {
    let mut scenario = small_room("");
    scenario.room.outline_m.clear();
    scenario.room.map = Some("map.yaml".into());
    // A border, and random cells inside.
    let (width, height, resolution_m) = (37, 23, 0.1);
    let is_wall = |x: usize, y: usize| {
        x == 0 || y == 0 || x == width - 1 || y == height - 1 || (x * 7 + y * y * 3) % 11 < 3
    };
    let grid = WallGrid {
        resolution_m,
        origin_m: [-1.0, 0.5],
        width,
        height,
        occupied: (0..width * height).map(|i| is_wall(i % width, i / width)).collect(),
    };
    let room = Room::new(&scenario, Some(&grid), &[]).unwrap();
    for y in 0..height {
        for x in 0..width {
            let centre = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) * resolution_m;
            let centre = centre + DVec2::from(grid.origin_m);
            assert_eq!(room.is_solid(centre, 0.0, 0.3), is_wall(x, y), "cell {x}, {y}");
            assert!(room.encloses(centre));
        }
    }
    assert!(room.prisms().len() < grid.occupied.iter().filter(|&&wall| wall).count());

    let world = World::new(&scenario, Some(&grid), super::RESOLUTION, 0).unwrap();
    for &(x, y) in &world.truth().surfaces {
        let centre = (DVec2::new(f64::from(x), f64::from(y)) + 0.5) * 0.05;
        assert!(room.is_solid(centre, 0.2, 0.3), "no wall in {x}, {y}");
    }
    assert!(World::new(&scenario, None, super::RESOLUTION, 0).is_err());
}

#[test]
fn the_truth_of_an_empty_room_is_the_inner_faces_of_its_walls() {
    let scenario = small_room(
        "[[robots]]
        id = 1
        start = { x_m = 1.0, y_m = 1.0 }",
    );
    let truth = super::world(&scenario, 0).truth().clone();
    // There are 80 x 60 cells inside, and the faces lie on the outer edges of these.
    assert_eq!(truth.free.len(), 80 * 60);
    let expected: Vec<(i32, i32)> = (-1..=80)
        .flat_map(|x| (-1..=60).map(move |y| (x, y)))
        .filter(|&(x, y)| (x == -1 || x == 80) != (y == -1 || y == 60))
        .collect();
    let missing: Vec<_> = expected.iter().filter(|cell| !truth.surfaces.contains(cell)).collect();
    assert!(missing.is_empty(), "{missing:?}");
    assert_eq!(truth.surfaces.len(), expected.len());
}

#[test]
fn a_box_at_a_wall_hides_the_wall_and_its_own_inside() {
    let scenario = small_room(
        "[[furniture]]
        footprint.box = { centre_m = [3.48, 1.5], size_m = [1.06, 1.02] }
        top_m = 0.5
        [[robots]]
        id = 1
        start = { x_m = 1.0, y_m = 1.0 }",
    );
    let truth = super::world(&scenario, 0).truth().clone();
    // The box starts at x = 2.95 and extends from y = 0.99 to y = 2.01.
    assert!(truth.surfaces.contains(&(59, 30)));
    let inside = |cell: &&(i32, i32)| cell.0 >= 60 && (20..40).contains(&cell.1);
    assert_eq!(truth.surfaces.iter().find(inside), None);
    assert_eq!(truth.free.iter().find(inside), None);
    assert!(truth.surfaces.contains(&(80, 45)), "the wall beside it is still seen");
}
