//! Whole placements: the instances of the README's table, and requests of all kinds.

use super::super::{
    camera::{CameraModel, Projection},
    candidates::{CandidatesError, Choices},
    floor_plan::{Enclosure, FloorPlan},
    placing::{Aim, Critical, CriticalRule, Placement, PlacementError, Request, Stage, place},
};

fn room(width: f64, depth: f64) -> FloorPlan {
    let outline = vec![[0.0, 0.0], [width, 0.0], [width, depth], [0.0, depth]];
    FloorPlan::new(Enclosure::Outline(outline), vec![], [3.0, 0.3], 0.5).unwrap()
}

/// The request for the paper's programme, as in the table.
fn request(spacing_m: f64) -> Request {
    let model = CameraModel { horizontal_fov_deg: 69.0, vertical_fov_deg: 55.0, range_m: 10.0 };
    Request {
        projection: Projection::Paper,
        model,
        picture: model,
        readable_m: f64::INFINITY,
        choices: Choices {
            heights_m: vec![3.0],
            tilts_deg: vec![90.0],
            headings: 4,
            spacing_m: Some(spacing_m),
        },
        at_least: 1,
        at_most: Some(3),
        aim: Aim::Cover,
        critical: None,
        connect: false,
        milp: None,
        seed: 1,
    }
}

/// Computes a placement; the time is a number of reports instead of seconds.
fn place_within(
    plan: &FloorPlan,
    request: &Request,
    reports: u32,
) -> Result<Placement, PlacementError> {
    let mut count = 0;
    place(plan, request, &mut |_| {
        count += 1;
        f64::from(count) / f64::from(reports)
    })
}

#[test]
fn the_instances_are_proved_optimal() {
    for (width, depth, spacing, candidates, optimum) in
        [(10.0, 8.0, 0.5, 640, 6), (20.0, 15.0, 0.5, 2_400, 20), (40.0, 30.0, 1.0, 2_400, 104)]
    {
        let plan = room(width, depth);
        let placement = place_within(&plan, &request(spacing), 20_000).unwrap();
        assert_eq!(placement.candidates, candidates);
        assert_eq!(placement.cameras.len(), optimum);
        assert!(placement.is_optimal() && placement.gap() == 0.0);
        assert!(placement.overlap.iter().all(|overlap| (1..=3).contains(overlap)));
    }
}

#[test]
fn the_same_seed_gives_the_same_placement() {
    let plan = room(10.0, 8.0);
    let [first, second] = [1, 1].map(|seed| Request { seed, ..request(0.5) });
    let [first, second] = [first, second].map(|it| place_within(&plan, &it, 1_000).unwrap());
    assert_eq!(first, second);
}

#[test]
fn a_number_of_cameras_covers_as_much_as_it_can() {
    let plan = room(10.0, 8.0);
    for cameras in 1..=7 {
        let request = Request { aim: Aim::Cameras(cameras), ..request(0.5) };
        let placement = place_within(&plan, &request, 300).unwrap();
        let covered = placement.overlap.iter().filter(|overlap| **overlap > 0).count();
        assert_eq!(placement.value, covered as u64);
        assert!(placement.value <= placement.bound);
        // Each camera sees 63 cells, and three fit without overlap.
        assert!(covered >= 63 * cameras.min(3) && placement.cameras.len() <= cameras);
        assert_eq!(covered == 320, cameras >= 6);
    }
    let all = Request { aim: Aim::Cameras(9), ..request(0.5) };
    assert!(place_within(&plan, &all, 300).unwrap().is_optimal());
}

#[test]
fn a_share_of_the_floor_takes_fewer_cameras() {
    let plan = room(10.0, 8.0);
    let cameras = |share: f64| {
        let request = Request { aim: Aim::Share(share), ..request(0.5) };
        let placement = place_within(&plan, &request, 300).unwrap();
        let covered = placement.overlap.iter().filter(|overlap| **overlap > 0).count();
        assert!(covered as f64 >= share * 320.0 - 1e-9);
        placement.cameras.len()
    };
    // 63 of 320 cells are 19.7 %.
    assert_eq!([0.19, 0.2, 0.39, 0.59, 1.0].map(cameras), [1, 2, 2, 3, 6]);
    assert_eq!(cameras(0.0), 0);
}

#[test]
fn critical_cells_follow_each_rule() {
    let plan = room(10.0, 8.0);
    // Three columns in the west.
    let cells: Vec<bool> = plan.cells().iter().map(|cell| cell.column < 3).collect();
    let placed = |rule: CriticalRule, aim: Aim| {
        let critical = Some(Critical { cells: cells.clone(), rule });
        place_within(&plan, &Request { aim, critical, ..request(0.5) }, 300).unwrap()
    };
    let least = |placement: &Placement, is_critical: bool| {
        let overlap = placement.overlap.iter().zip(&cells);
        overlap.filter(|(_, it)| **it == is_critical).map(|(overlap, _)| *overlap).min()
    };
    let twice = placed(CriticalRule::Twice, Aim::Cover);
    assert_eq!((least(&twice, true), least(&twice, false)), (Some(2), Some(1)));
    assert!(twice.cameras.len() > 6);
    // Across the 16 rows it takes two cameras, and four to see every cell twice.
    let only = placed(CriticalRule::Only, Aim::Cover);
    assert_eq!((only.cameras.len(), least(&only, true)), (2, Some(1)));
    assert!(only.is_optimal());
    // A camera sees more than six columns and rows; the critical cells come first.
    let weighted = placed(CriticalRule::Weighted, Aim::Cameras(2));
    assert_eq!(least(&weighted, true), Some(1));
    let few = placed(CriticalRule::Twice, Aim::Cameras(4));
    assert_eq!(least(&few, true), Some(2));
    let too_few = Request {
        aim: Aim::Cameras(3),
        critical: Some(Critical { cells: cells.clone(), rule: CriticalRule::Twice }),
        ..request(0.5)
    };
    assert_eq!(
        place_within(&plan, &too_few, 300),
        Err(PlacementError::TooFewCameras { cameras: 3, least: 4 })
    );
}

#[test]
#[ignore = "long: cargo thorough"]
fn overlap_is_connected_for_free_or_with_more_cameras() {
    let plan = room(20.0, 15.0);
    let report = |request: &Request| place_within(&plan, request, 20_000).unwrap();
    let plain = report(&request(0.5));
    assert_eq!((plain.cameras.len(), plain.added), (20, 0));
    let connected = report(&Request { connect: true, ..request(0.5) });
    assert_eq!((connected.pieces, connected.fewest_pieces), (1, 1));
    assert_eq!(connected.cameras.len(), 20 + connected.added);
    assert!(connected.is_optimal());
    assert!(connected.overlap.iter().all(|overlap| (1..=3).contains(overlap)));
}

#[test]
fn coverage_is_given_up_to_connect_a_number_of_cameras() {
    let plan = room(20.0, 15.0);
    let four = Request { aim: Aim::Cameras(4), ..request(0.5) };
    let plain = place_within(&plan, &four, 3_000).unwrap();
    // Four cameras fit without any overlap.
    assert_eq!((plain.value, plain.pieces), (4 * 63, 4));
    let connected = place_within(&plan, &Request { connect: true, ..four }, 3_000).unwrap();
    assert_eq!((connected.cameras.len(), connected.pieces), (4, 1));
    // Connecting four cameras takes at least three shared cells.
    assert!((220..=4 * 63 - 3).contains(&connected.value), "{} cells", connected.value);
}

/// Overlap in which no marker can be read connects nothing.
#[test]
fn overlap_counts_where_markers_can_be_read() {
    let plan = room(20.0, 15.0);
    let four = Request { aim: Aim::Cameras(4), connect: true, ..request(0.5) };
    let [height] = four.choices.heights_m[..] else { panic!("one height") };
    // From the ceiling, a marker that can't be read from its height is read nowhere.
    for (readable_m, pieces) in [(0.99 * height, 4), (10.0 * height, 1)] {
        let request = Request { readable_m, ..four.clone() };
        let placed = place_within(&plan, &request, 3_000).unwrap();
        assert_eq!((placed.cameras.len(), placed.pieces), (4, pieces), "{readable_m} m");
    }
}

#[test]
fn impossible_requests_are_refused_in_one_line() {
    let plan = room(10.0, 8.0);
    let model = CameraModel { range_m: 2.0, ..request(0.5).model };
    let tilted = |tilt: f64| Choices { tilts_deg: vec![tilt], ..request(0.5).choices };
    let high = Choices { heights_m: vec![3.5], ..request(0.5).choices };
    let pinhole = Request { projection: Projection::Pinhole, ..request(0.5) };
    let twice = |cells| Some(Critical { cells, rule: CriticalRule::Twice });
    let nowhere = twice(vec![false; 320]);
    let everywhere = twice(vec![true; 320]);
    for (request, expected) in [
        (Request { at_least: 3, at_most: Some(2), ..request(0.5) }, "at least 3 and at most 2"),
        (Request { model, ..pinhole.clone() }, "can't see the floor from a height of 3 m"),
        (Request { choices: tilted(-30.0), ..pinhole.clone() }, "2.5 degrees down"),
        (Request { choices: tilted(60.0), ..request(0.5) }, "straight down"),
        (Request { choices: high, ..request(0.5) }, "above the ceiling (3 m)"),
        (Request { critical: nowhere, ..request(0.5) }, "no cell of the floor is critical"),
        (Request { critical: everywhere, at_most: Some(1), ..request(0.5) }, "seen twice"),
        (Request { connect: true, at_most: Some(1), ..request(0.5) }, "connected"),
    ] {
        let error = place_within(&plan, &request, 50).expect_err(expected).to_string();
        assert!(error.contains(expected), "{error} does not say {expected}");
        assert_eq!(error.lines().count(), 1);
    }
    // With places 2 m apart, the floor can't be covered without overlap.
    let once = Request { at_most: Some(1), ..request(2.0) };
    let error = place_within(&plan, &once, 500).expect_err("once");
    assert!(matches!(error, PlacementError::Infeasible { .. }), "{error}");
    let many = Choices { spacing_m: Some(0.01), ..request(0.5).choices };
    let many = place_within(&plan, &Request { choices: many, ..request(0.5) }, 50);
    assert!(matches!(
        many,
        Err(PlacementError::Candidates(CandidatesError::TooMany { count: 1_600_000 }))
    ));
}

#[test]
fn a_stopped_search_returns_the_best_placement() {
    let plan = room(20.0, 15.0);
    let mut is_found = false;
    let placement = place(&plan, &request(0.5), &mut |stage| {
        is_found |= matches!(stage, Stage::Solving(interim) if interim.cameras.is_some());
        if is_found { f64::INFINITY } else { 0.0 }
    });
    let placement = placement.unwrap();
    assert!(placement.cameras.len() >= 20 && placement.bound <= 20);
    assert!(placement.overlap.iter().all(|overlap| (1..=3).contains(overlap)));
}
