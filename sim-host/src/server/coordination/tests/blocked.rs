//! Robots that are blocked where the map shows no obstacle.

use ubimap_protocol::message::EventCode;

use super::{
    floor::{Floor, id},
    plan::Plan,
};
use crate::server::coordination::{Errand, Notice, ground::Point};

/// Its own planner finds no way, whatever the server sends.
#[test]
fn a_robot_that_is_blocked_again_and_again_is_sent_more_and_more_rarely_and_its_goal_given_up() {
    let start = Point::new(1.0, 1.0);
    let mut floor = Floor::new(Plan::room(8.0, 5.0), &[start], 1, |_| false);
    floor.run(2, |_| false);
    floor.coordinator.goal(id(0), 6.0, 3.0, floor.now).unwrap();
    let mut attempts = Vec::new();
    floor.run(120, |floor| {
        if (floor.bodies[0].place - start).norm() > 0.02 {
            floor.bodies[0].place = start;
            let now = floor.now;
            if attempts.last().is_none_or(|last| now.since(*last).micros() > 1_000_000) {
                attempts.push(now);
                floor.coordinator.event(id(0), EventCode::PathBlocked, now);
            }
        }
        false
    });
    let seconds: Vec<u64> =
        attempts.windows(2).map(|two| two[1].since(two[0]).micros() / 1_000_000).collect();
    assert!(seconds.is_sorted() && seconds.last() >= Some(&16), "{seconds:?}");
    assert_eq!(attempts.len(), 6, "{seconds:?}");
    assert_eq!([Notice::Blocked, Notice::GaveUp].map(|it| floor.count(it)), [1, 1]);
    assert_eq!(floor.coordinator.errand(id(0)), Some(Errand::Idle));
}

/// As soon as the robot can drive, it is sent to its goal as ever.
#[test]
fn a_robot_that_was_blocked_twice_reaches_its_goal() {
    let start = Point::new(1.0, 1.0);
    let mut floor = Floor::new(Plan::room(8.0, 5.0), &[start], 1, |_| false);
    floor.run(2, |_| false);
    floor.coordinator.goal(id(0), 6.0, 3.0, floor.now).unwrap();
    for _ in 0..2 {
        floor.run(6, |_| false);
        floor.bodies[0].place = start;
        floor.coordinator.event(id(0), EventCode::PathBlocked, floor.now);
    }
    assert!(floor.run(60, |floor| floor.count(Notice::Reached) > 0));
    assert_eq!(floor.count(Notice::GaveUp), 0);
}
