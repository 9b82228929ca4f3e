use nalgebra::Vector2;
use ubimap_protocol::{
    message::DistanceVector,
    time::Instant,
    units::{Angle, RobotId},
};

use super::*;
use crate::mapping::submaps::{Measured, Refined};

/// The walls of a corridor of 2 m around a block of 8 by 5 m, with a niche in each.
fn walls() -> Vec<[f64; 4]> {
    let ring = |low: [f64; 2], high: [f64; 2], depth: f64, niches: [f64; 4]| {
        let corners = [low, [high[0], low[1]], high, [low[0], high[1]]];
        let mut walls = Vec::new();
        for side in 0..4 {
            let (from, to) = (Vector2::from(corners[side]), Vector2::from(corners[(side + 1) % 4]));
            let along = (to - from).normalize();
            let place =
                |way: f64, off: f64| from + along * way + Vector2::new(along.y, -along.x) * off;
            let (start, end, length) = (niches[side], niches[side] + 0.9, (to - from).norm());
            let ways =
                [(0.0, 0.0), (start, 0.0), (start, depth), (end, depth), (end, 0.0), (length, 0.0)];
            walls.extend(ways.windows(2).map(|pair| {
                let [a, b] = [place(pair[0].0, pair[0].1), place(pair[1].0, pair[1].1)];
                [a.x, a.y, b.x, b.y]
            }));
        }
        walls
    };
    let mut walls = ring([-1.0, -1.0], [11.0, 8.0], 0.5, [2.0, 5.5, 3.1, 1.7]);
    walls.extend(ring([1.0, 1.0], [9.0, 6.0], -0.4, [4.7, 2.2, 1.3, 3.0]));
    walls
}

/// What a sensor with 64 columns over 90 degrees and a range of 4 m sees from a pose, in a second.
fn view(walls: &[[f64; 4]], truth: &Motion, reported: &Motion, second: u64) -> View {
    let distances = (0..64).map(|column| {
        let angle = (f64::from(column) - 31.5) * 256.0 / 65_536.0 * core::f64::consts::TAU;
        let way = truth.rotation * Vector2::new(angle.cos(), angle.sin());
        let ranges = walls.iter().filter_map(|&[x0, y0, x1, y1]| {
            let (side, from) =
                (Vector2::new(x1 - x0, y1 - y0), Vector2::new(x0, y0) - truth.translation.vector);
            let cross = |a: Vector2<f64>, b: Vector2<f64>| a.x * b.y - a.y * b.x;
            let (range, part) =
                (cross(from, side) / cross(way, side), cross(from, way) / cross(way, side));
            (range > 0.0 && (0.0..=1.0).contains(&part)).then_some(range)
        });
        match ranges.fold(9.0, f64::min) {
            range if range <= 4.0 => (range / 0.02).round() as u8,
            _ => DistanceVector::BEYOND,
        }
    });
    View::of(&DistanceVector {
        time: Instant(second * 1_000_000),
        pose: submaps::pose(reported),
        first: Angle((-31.5f64 * 256.0) as i32 as u16),
        step: 256,
        distances: distances.collect(),
        odometry: None,
    })
}

fn match_all(all: &mut Trajectories) {
    while all.is_matching() {
        all.advance();
    }
}

fn solve(all: &mut Trajectories) {
    all.solve();
    while all.is_solving() {
        all.solve();
    }
}

/// A robot's way around the block: motions of a second each, in metres and degrees.
fn round() -> Vec<(f64, f64)> {
    let side = |length: usize| (0..length).map(|_| (0.25, 0.0)).chain((0..6).map(|_| (0.0, 15.0)));
    [40, 28, 40, 28].into_iter().flat_map(side).collect()
}

/// Drives around, with a compass that drifts by 0.02 degrees in each step, seen by cameras at the
/// beginning. The graph is solved every second time, or a part of an iteration each time. Returns the trajectories, and the
/// times with the true and the reported poses.
fn driven(rounds: usize, in_parts: bool) -> (Trajectories, Vec<(u64, Motion, Motion)>) {
    let (walls, robot) = (walls(), RobotId(3));
    let (mut truth, mut reported) = (Motion::identity(), Motion::identity());
    let (mut all, mut poses) = (Trajectories::default(), Vec::new());
    let ways = (0..rounds).flat_map(|_| round());
    for (second, (way, turn)) in (0u64..).zip(ways) {
        let seen = (second < 3).then_some(truth);
        let by = poses.last().map(|(_, _, last): &(u64, Motion, Motion)| last.inv_mul(&reported));
        let step = by
            .filter(|_| second >= 3)
            .map(|by| Step::new(by, [0.02, 0.02], Some([0.01, 0.01, 0.01])));
        all.add(robot, &view(&walls, &truth, &reported, second), reported, step, seen);
        match_all(&mut all);
        if in_parts {
            all.solve();
        } else if second % 2 == 0 {
            solve(&mut all);
        }
        poses.push((second, truth, reported));
        let turned = turn.to_radians();
        truth *= Motion::new(Vector2::new(way, 0.0), turned);
        let drift = if second >= 3 { 0.02f64.to_radians() } else { 0.0 };
        reported *= Motion::new(Vector2::new(way, 0.0), turned + drift);
    }
    // What was begun, and what came after that.
    (0..2).for_each(|_| solve(&mut all));
    (all, poses)
}

/// By how much what a robot drew is off where it is put: greatest distance in metres.
fn off(corrections: &[Correction], poses: &[(u64, Motion, Motion)]) -> f64 {
    let at = |second: u64| {
        let after = corrections.partition_point(|it| u64::from(it.since) <= second);
        after.checked_sub(1).map_or_else(Motion::identity, |it| submaps::motion(corrections[it].by))
    };
    let off = poses.iter().map(|(second, truth, reported)| {
        (truth.translation.vector - (at(*second) * reported).translation.vector).norm()
    });
    off.fold(0.0, f64::max)
}

#[test]
fn what_was_drawn_on_rounds_with_a_drift_comes_to_where_it_was() {
    for in_parts in [false, true] {
        let (mut all, poses) = driven(2, in_parts);
        let before = off(&[], &poses);
        let after = off(&all.placement(RobotId(3), Millimetres(50)).corrections, &poses);
        println!("off by {before:.2} m when it was drawn, by {after:.2} m after it was moved");
        assert!(before > 0.5 && after < 0.2, "{before} {after}, in parts: {in_parts}");
    }
}

#[test]
fn where_nothing_is_wrong_nothing_moves() {
    let (walls, mut truth, mut all) = (walls(), Motion::identity(), Trajectories::default());
    for (second, (way, turn)) in (0u64..).zip(round()) {
        all.add(RobotId(3), &view(&walls, &truth, &truth, second), truth, None, Some(truth));
        match_all(&mut all);
        solve(&mut all);
        truth *= Motion::new(Vector2::new(way, 0.0), turn.to_radians());
    }
    let moved: Vec<Correction> = all.placement(RobotId(3), Millimetres(50)).corrections;
    assert!(moved.iter().all(|it| it.by == Pose::default()), "{moved:?}");
    // A robot that stands for a day adds nothing.
    let pieces = all.pieces.len();
    for second in 1_000..2_000 {
        all.add(RobotId(3), &view(&walls, &truth, &truth, second), truth, None, Some(truth));
    }
    assert!(all.pieces.len() <= pieces + 1, "{} {pieces}", all.pieces.len());
}

#[test]
fn robots_that_come_and_go_leave_nothing_behind() {
    let (walls, mut all) = (walls(), Trajectories::default());
    for number in 0..9_000u16 {
        let at = Motion::identity();
        all.add(RobotId(number), &view(&walls, &at, &at, u64::from(number)), at, None, Some(at));
        all.forget(RobotId(number));
        let _ = all.settle();
    }
    assert!(all.robots.len() == all.pieces.len() && all.pieces.len() < 4_000);
}

#[test]
fn settled_pieces_stay_where_they_are() {
    let (mut all, _) = driven(1, false);
    let (robot, before) = (RobotId(3), all.placement(RobotId(3), Millimetres(50)).corrections);
    let walls = walls();
    let there = all.newest(robot).unwrap();
    // It drives to and fro until the oldest pieces are settled.
    let mut second = 1_000;
    while all.robots[&robot].settled.corrections.is_empty() {
        let at = there * Motion::translation(if second % 2 == 0 { 0.0 } else { 0.1 }, 0.0);
        all.add(robot, &view(&walls, &at, &at, second), at, None, None);
        if second % 64 == 0 {
            solve(&mut all);
        }
        second += 1;
    }
    let after = all.placement(robot, Millimetres(50)).corrections;
    assert!(all.pieces.len() < 4_000);
    let both = before.iter().zip(&after).take(40);
    for (before, after) in both {
        let moved = submaps::motion(before.by).inv_mul(&submaps::motion(after.by));
        assert!(
            before.since == after.since && is_within(&moved, (0.3, 0.1)),
            "{before:?} {after:?}"
        );
    }
    // What no cell needs is forgotten.
    assert!(all.take_settled() && !all.take_settled());
    let (first, drawn) = (after[0].since, after[7]);
    all.thin(robot, &BTreeSet::from([first, drawn.since]));
    let left = all.placement(robot, Millimetres(50)).corrections;
    assert_eq!(left[..2], [after[0], drawn]);
    assert!(left.len() < after.len(), "{} {}", left.len(), after.len());
}

/// Against the covariances of the graph, whose only measurements are the steps.
#[test]
fn a_piece_is_as_sure_as_the_steps_since_the_last_one_that_was_held() {
    let (robot, mut all) = (RobotId(3), Trajectories::default());
    let mut pose = Motion::new(Vector2::new(1.0, 2.0), 0.4);
    for (second, (way, turn)) in (0..).zip(round().into_iter().take(90)) {
        let seen = (second < 8).then_some(pose);
        let by = Motion::new(Vector2::new(way, 0.0), turn.to_radians());
        let step = (second >= 8).then(|| Step::new(by, [0.02, 0.02], None));
        if second > 0 {
            pose *= by;
        }
        all.add(robot, &view(&[], &pose, &pose, second), pose, step, seen);
    }
    let last = all.pieces.len() - 1;
    let held = all.pieces.iter().rposition(|it| it.held.is_some()).unwrap();
    assert!(held > 1 && last > held + 20, "{held} {last}");
    let steps = all.steps.iter().map(|it| Edge { is_doubted: false, ..it.clone() }).collect();
    let graph = PoseGraph { poses: all.graph.poses.clone(), edges: steps, absolutes: Vec::new() };
    let turn = turned(all.graph.poses[held].rotation.angle());
    let exact = turn * graph.relative_covariances(held, &[last])[0] * turn.transpose();
    // That of the pose that is held is put at the end of the way.
    let arm = Measured { motion: all.graph.poses[held], covariance: covariance(SEEN) };
    let by = all.graph.poses[held].inv_mul(&all.graph.poses[last]);
    let seen = arm.then(&Measured { motion: by, covariance: Matrix3::zeros() }).covariance;
    let expected = seen + exact * WARY * WARY;
    let off = all.believed(last).covariance - expected;
    assert!(off.amax() < 1e-3 * expected.amax(), "{off} {expected}");
}

#[test]
fn a_match_may_not_move_a_piece_by_more_than_the_steps_explain() {
    let (all, _) = driven(2, false);
    let (number, other) = all
        .matches
        .iter()
        .enumerate()
        .find_map(|(number, its)| Some((number, its.first()?.from)))
        .unwrap();
    let predicted = all.predicted(number);
    let there = all.graph.poses[other].inv_mul(&all.graph.poses[number]);
    let found = |degrees: f64| Refined {
        motion: there * Motion::rotation(degrees.to_radians()),
        covariance: covariance([0.03, 0.03, 0.01]),
        matched: 60,
        rms_m: 0.02,
    };
    let is_plausible = |it: &Refined| all.plausible((number, &predicted), other, it).is_some();
    assert!(is_plausible(&found(1.0)) && is_plausible(&found(-2.0)));
    // Less than the 11.5 degrees from which a match is refused in any case.
    assert!(!is_plausible(&found(10.0)) && !is_plausible(&found(-10.0)));
}

#[test]
fn a_robot_that_is_far_off_comes_back_where_the_whole_map_suggests() {
    let (walls, robot) = (walls(), RobotId(3));
    for is_suggested in [false, true] {
        let (mut all, poses) = driven(1, false);
        let (mut second, mut truth, _) = *poses.last().unwrap();
        // It drives another side without seeing anything, and is far off after that.
        let mut reported = all.newest(robot).unwrap();
        for corner in [15.0f64; 1].into_iter().chain([0.0; 19]) {
            second += 1;
            let turn = corner.to_radians();
            truth *= Motion::new(Vector2::new(0.25, 0.0), turn);
            let by = Motion::new(Vector2::new(0.25, 0.015), turn + 0.008);
            reported *= by;
            let step = Step::new(by, [0.1, 0.1], None);
            all.add(robot, &view(&[], &truth, &reported, second), reported, Some(step), None);
            match_all(&mut all);
            solve(&mut all);
        }
        let off = |all: &Trajectories, truth: &Motion| {
            (all.newest(robot).unwrap().translation.vector - truth.translation.vector).norm()
        };
        assert!(off(&all, &truth) > 0.6, "{}", off(&all, &truth));
        for _ in 0..8 {
            second += 1;
            let by = Motion::translation(0.25, 0.0);
            (truth, reported) = (truth * by, reported * by);
            let step = Step::new(by, [0.02, 0.02], Some([0.01, 0.01, 0.01]));
            all.add(robot, &view(&walls, &truth, &reported, second), reported, Some(step), None);
            if is_suggested {
                all.suggest(robot, truth);
            }
            match_all(&mut all);
            solve(&mut all);
        }
        assert_eq!(off(&all, &truth) < 0.5, is_suggested, "{}", off(&all, &truth));
    }
}

/// Cameras see it on two sides of the block; then its odometry misses a turn of three degrees, while it goes to where it
/// sees nothing that it knows.
#[test]
fn a_robot_knows_its_heading_by_the_walls_alone() {
    let (walls, robot, mut all) = (walls(), RobotId(3), Trajectories::default());
    let (mut truth, mut reported, mut last) = (Motion::identity(), Motion::identity(), None);
    let ways = round();
    let seen = ways.len() / 2;
    let jump = [(5.0, 0.0, 3.0)].into_iter().chain([(0.25, 0.0, 0.0); 8]);
    let ways = ways[..seen].iter().map(|&(way, turn)| (way, turn, 0.0)).chain(jump);
    for (second, (way, turn, err)) in (0u64..).zip(ways) {
        let is_seen = second <= seen as u64;
        let step = last.map(|last: Motion| Step::new(last.inv_mul(&reported), [0.05, 0.05], None));
        let step = step.filter(|_| !is_seen);
        let view = view(&walls, &truth, &reported, second);
        all.add(robot, &view, reported, step, is_seen.then_some(truth));
        match_all(&mut all);
        last = Some(reported);
        truth *= Motion::new(Vector2::new(way, 0.0), turn.to_radians());
        reported *= Motion::new(Vector2::new(way, 0.0), (turn + err).to_radians());
    }
    (0..3).for_each(|_| solve(&mut all));
    // The last motion is not in a view.
    let found = all.newest(robot).unwrap() * last.unwrap().inv_mul(&reported);
    let off = |pose: Motion| truth.rotation.rotation_to(&pose.rotation).angle().to_degrees().abs();
    assert!(off(reported) > 2.9 && off(found) < 1.0, "{}, {}", off(reported), off(found));
    // Of a robot whose sensor was askew, all of that is wrong.
    all.void_ground(robot);
    assert_eq!(all.headings().count(), 0);
}
