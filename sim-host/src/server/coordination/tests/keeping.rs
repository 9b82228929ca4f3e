//! Drives of robots that are kept to a part of the floor.

use ubimap_protocol::units::Millimetres;

use super::{
    floor::{Floor, RADIUS_M, id},
    plan::Plan,
};
use crate::{
    grid::OccupancyGrid,
    server::coordination::{Area, DrivableFloor, GoalError, Notice, ground::Point},
};
use ubimap_protocol::tile::Cell;

const SIDE: Millimetres = Millimetres(50);

/// A hall of 8 m by 5 m in which robots may use the western 5 m.
fn western_part() -> DrivableFloor {
    let corners = vec![[-1.0, -1.0], [5.0, -1.0], [5.0, 6.0], [-1.0, 6.0]];
    DrivableFloor::new(SIDE, Some(&Area::Polygon(corners)), None).unwrap()
}

#[test]
fn a_goal_outside_is_refused_and_one_inside_is_reached() {
    let starts = [Point::new(1.0, 1.0)];
    let mut floor = Floor::new(Plan::room(8.0, 5.0), &starts, 1, |_| false);
    let goal = |floor: &mut Floor, x, y| floor.coordinator.goal(id(0), x, y, floor.now);
    // Without a limit, both goals will do.
    assert_eq!(goal(&mut floor, 7.0, 4.0), Ok(()));
    floor.coordinator.keep_to(western_part());
    floor.run(2, |_| false);
    assert_eq!(goal(&mut floor, 7.0, 4.0), Err(GoalError::OutsideFloor));
    assert_eq!(goal(&mut floor, 1e9, f64::NAN), Err(GoalError::OutsideFloor));
    assert_eq!(goal(&mut floor, 4.9, 4.0), Err(GoalError::Occupied), "its side would be outside");
    assert_eq!(goal(&mut floor, 4.5, 4.0), Ok(()));
    assert!(floor.run(60, |floor| floor.count(Notice::Reached) > 0));
}

#[test]
fn a_robot_that_stands_outside_of_its_floor_comes_back() {
    let mut floor = Floor::new(Plan::room(8.0, 5.0), &[Point::new(7.0, 2.0)], 4, |_| false);
    floor.coordinator.keep_to(western_part());
    floor.run(2, |_| false);
    floor.coordinator.goal(id(0), 2.0, 4.0, floor.now).unwrap();
    assert!(floor.run(60, |floor| floor.count(Notice::Reached) > 0));
}

/// A wall is between the robot and its floor.
#[test]
fn the_way_back_to_the_floor_leads_through_no_wall() {
    let mut plan = Plan::room(8.0, 5.0);
    plan.wall(5.5, 0.0, 5.7, 5.0);
    let mut floor = Floor::new(plan, &[Point::new(7.0, 2.0)], 4, |_| false);
    floor.coordinator.keep_to(western_part());
    floor.run(2, |_| false);
    let refused = floor.coordinator.goal(id(0), 2.0, 4.0, floor.now);
    assert_eq!(refused, Err(GoalError::Unreachable));
}

/// Nothing is known of the hall at first. The robots map their part of it, never leave it, and do not try
/// to look at the rest for ever.
#[test]
fn exploring_robots_stay_on_their_floor() {
    let starts = [Point::new(1.0, 1.0), Point::new(1.0, 3.5)];
    let hall = || Plan::room(8.0, 5.0);
    let mut floor = Floor::new(hall(), &starts, 2, |place| place.x > 2.0);
    floor.coordinator.keep_to(western_part());
    for index in 0..2 {
        assert!(floor.coordinator.set_exploring(id(index), true));
    }
    let mut easternmost = 0.0_f64;
    let is_unknown =
        |floor: &Floor, until: i32| (4..until).any(|x| (4..96).any(|y| floor.is_unknown((x, y))));
    floor.run(240, |floor| {
        floor.look_around();
        easternmost = floor.bodies.iter().map(|body| body.place.x).fold(easternmost, f64::max);
        false
    });
    assert!(!is_unknown(&floor, 96), "their own part is not mapped");
    assert!(is_unknown(&floor, 156), "sensors of 3 m can't see all from the west");
    // Drivers cut corners by some centimetres; the whole body stays inside.
    assert!(easternmost + RADIUS_M < 5.02, "a robot was at x = {easternmost} m");
    assert!(easternmost > 3.0, "{easternmost}");
    let idle = (0..2).all(|index| floor.coordinator.target(id(index)).is_none());
    assert!(idle, "they go on although their floor is known");
}

/// A wall of a floor plan that nobody has seen yet: the way round it is taken from the beginning.
#[test]
fn walls_of_a_plan_are_not_crossed_before_they_are_seen() {
    let (width, height) = (160, 100);
    let mut plan = OccupancyGrid::new(0.05, [0.0, 0.0], width, height).unwrap();
    for row in 0..60 {
        plan.set(80, row, Cell::Occupied);
    }
    let mut floor = Floor::new(Plan::room(8.0, 5.0), &[Point::new(2.0, 1.0)], 3, |_| false);
    floor.coordinator.keep_to(DrivableFloor::new(SIDE, None, Some(&plan)).unwrap());
    floor.run(2, |_| false);
    floor.coordinator.goal(id(0), 6.0, 1.0, floor.now).unwrap();
    let mut nearest = f64::INFINITY;
    let reached = floor.run(120, |floor| {
        let place = floor.bodies[0].place;
        if place.y < 3.0 {
            nearest = nearest.min((place.x - 4.025).abs());
        }
        floor.count(Notice::Reached) > 0
    });
    assert!(reached && nearest > RADIUS_M, "{nearest}");
}
