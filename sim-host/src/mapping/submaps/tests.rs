//! Tests of the graph as a whole, on graphs whose solution is known, and a corridor for others.

use nalgebra::{DMatrix, Matrix3, Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use ubimap_protocol::{message::DistanceVector, time::Instant, units::Angle};

use super::{
    loops::{Loop, Loops},
    pose_graph::{Edge, PoseGraph},
    rigid::{Measured, Motion, coordinates, difference, of_coordinates, pose, turned},
    view::View,
};

/// The walls of a corridor of 2 m around a block of 8 by 5 m, with niches at irregular places.
pub(super) fn walls() -> Vec<[f64; 4]> {
    let mut walls = Vec::new();
    let ring = |walls: &mut Vec<[f64; 4]>, corners: [[f64; 2]; 4], depth: f64, starts: [f64; 4]| {
        for side in 0..4 {
            let (from, to) = (corners[side], corners[(side + 1) % 4]);
            let length = (to[0] - from[0]).hypot(to[1] - from[1]);
            let along = [(to[0] - from[0]) / length, (to[1] - from[1]) / length];
            let place = |way: f64, off: f64| {
                [
                    from[0] + along[0] * way + along[1] * off,
                    from[1] + along[1] * way - along[0] * off,
                ]
            };
            let (start, end) = (starts[side], starts[side] + 0.9);
            let ways =
                [(0.0, 0.0), (start, 0.0), (start, depth), (end, depth), (end, 0.0), (length, 0.0)];
            for pair in ways.windows(2) {
                let [a, b] = [place(pair[0].0, pair[0].1), place(pair[1].0, pair[1].1)];
                walls.push([a[0], a[1], b[0], b[1]]);
            }
        }
    };
    ring(
        &mut walls,
        [[-1.0, -1.0], [11.0, -1.0], [11.0, 8.0], [-1.0, 8.0]],
        0.5,
        [2.0, 5.5, 3.1, 1.7],
    );
    ring(&mut walls, [[1.0, 1.0], [9.0, 1.0], [9.0, 6.0], [1.0, 6.0]], -0.4, [4.7, 2.2, 1.3, 3.0]);
    walls
}

/// The view of a sensor that has this number of beams over 180 degrees, merged into 64 columns.
pub(super) fn seen(
    beams: usize,
    walls: &[[f64; 4]],
    truth: &Motion,
    reported: &Motion,
    time: u64,
) -> View {
    let mut distances = [u8::MAX; 64];
    for beam in 0..beams {
        let angle = ((beam as f64 + 0.5) / beams as f64 - 0.5) * core::f64::consts::PI;
        let way = truth.rotation * Vector2::new(angle.cos(), angle.sin());
        let at = truth.translation.vector;
        let ranges = walls.iter().filter_map(|&[x0, y0, x1, y1]| {
            let (side, from) = (Vector2::new(x1 - x0, y1 - y0), Vector2::new(x0, y0) - at);
            let cross = |a: Vector2<f64>, b: Vector2<f64>| a.x * b.y - a.y * b.x;
            let size = cross(way, side);
            let (range, part) = (cross(from, side) / size, cross(from, way) / size);
            (range > 0.0 && (0.0..=1.0).contains(&part)).then_some(range)
        });
        let nearest = &mut distances[beam * 64 / beams];
        *nearest = (*nearest).min((ranges.fold(9.0, f64::min) / 0.02).round().min(255.0) as u8);
    }
    View::of(&DistanceVector {
        time: Instant(time * 1_000_000),
        pose: pose(reported),
        first: Angle((-31.5f64 * 512.0) as i32 as u16),
        step: 512,
        distances: distances.into_iter().collect(),
        odometry: None,
    })
}

/// Poses along a square that is driven round three times, and an edge from each to the next, with
/// noise: the true poses, and a graph that starts from dead reckoning.
fn rounds(rng: &mut ChaCha8Rng) -> (Vec<Motion>, PoseGraph) {
    let mut truth = vec![Motion::identity()];
    let mut graph = PoseGraph { poses: truth.clone(), ..PoseGraph::default() };
    for step in 1..60 {
        let turn = if step % 5 == 0 { core::f64::consts::FRAC_PI_2 } else { 0.0 };
        let step = Motion::new(Vector2::new(2.0, 0.0), turn);
        truth.push(truth[truth.len() - 1] * step);
        let edge = edge(&truth, (truth.len() - 2, truth.len() - 1), (0.02, 0.02), rng);
        graph.poses.push(graph.poses[edge.from] * edge.motion);
        graph.edges.push(edge);
    }
    (truth, graph)
}

fn edge(
    truth: &[Motion],
    (from, to): (usize, usize),
    (metres, radians): (f64, f64),
    rng: &mut ChaCha8Rng,
) -> Edge {
    let mut noise = || rng.random_range(-1.7..1.7);
    let off = Vector3::new(noise() * metres, noise() * metres, noise() * radians);
    let motion = of_coordinates(coordinates(&truth[from].inv_mul(&truth[to])) + off);
    let squares = Vector3::new(metres * metres, metres * metres, radians * radians);
    let information = Matrix3::from_diagonal(&squares.map(f64::recip));
    Edge { from, to, motion, information, is_doubted: false }
}

fn worst(graph: &PoseGraph, truth: &[Motion]) -> f64 {
    let off = |(one, other): (&Motion, &Motion)| difference(one, other).xy().norm();
    graph.poses.iter().zip(truth).map(off).fold(0.0, f64::max)
}

/// The oracle is a graph with the correct loops alone.
#[test]
fn loops_are_closed_though_three_of_ten_are_wrong() {
    let (mut wrong, mut wrong_kept, mut right, mut right_kept) = (0, 0, 0, 0);
    let mut farthest = 0.0f64;
    for seed in 0..20 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (truth, graph) = rounds(&mut rng);
        let mut loops = Loops::default();
        loops.extend(None);
        for edge in &graph.edges {
            loops.extend(Some(&measured(edge)));
        }
        let mut is_wrong = Vec::new();
        for to in 20..60 {
            let mut found = edge(&truth, (to, to - 20), (0.02, 0.01), &mut rng);
            is_wrong.push(rng.random_range(0..10) < 3);
            if is_wrong[to - 20] {
                let off = Vector2::new(rng.random_range(-3.0..3.0), rng.random_range(-3.0..3.0));
                found.motion *= Motion::new(off, rng.random_range(-0.5..0.5));
            }
            loops.push(Loop { from: to, to: to - 20, measured: measured(&found) });
        }
        loops.choose();
        let solved = |chosen: &mut dyn Iterator<Item = usize>| {
            let mut graph = graph.clone();
            graph.edges.extend(chosen.map(|index| loops.all[index].edge()));
            graph.solve();
            graph
        };
        let found = solved(&mut loops.accepted.iter().copied());
        let oracle = solved(&mut (0..40).filter(|&index| !is_wrong[index]));
        farthest = farthest.max(worst(&found, &oracle.poses));
        wrong += is_wrong.iter().filter(|it| **it).count();
        right += is_wrong.iter().filter(|it| !**it).count();
        wrong_kept += loops.accepted.iter().filter(|&&index| is_wrong[index]).count();
        right_kept += loops.accepted.iter().filter(|&&index| !is_wrong[index]).count();
    }
    println!(
        "{right_kept} of {right} right and {wrong_kept} of {wrong} wrong loops were kept; poses at most \
         {farthest:.3} m from those with the right loops alone"
    );
    assert!(100 * right_kept >= 95 * right && 100 * wrong_kept <= 5 * wrong);
    assert!(farthest < 0.1, "{farthest}");
}

fn measured(edge: &Edge) -> Measured {
    let covariance = edge.information.try_inverse().unwrap();
    Measured { motion: edge.motion, covariance }
}

/// Against the inverse of the dense matrix, by numerical derivatives.
#[test]
fn relative_covariances_are_those_of_the_dense_matrix() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let (truth, mut graph) = rounds(&mut rng);
    graph.edges.push(edge(&truth, (45, 5), (0.03, 0.01), &mut rng));
    graph.solve();
    let (node, size) = (30, 3 * graph.poses.len());
    let mut dense = DMatrix::<f64>::zeros(size, size);
    for edge in &graph.edges {
        let mut by = DMatrix::<f64>::zeros(3, size);
        let residual = edge.residual(&graph.poses);
        for (which, axis) in
            [edge.from, edge.to].into_iter().flat_map(|it| (0..3).map(move |axis| (it, axis)))
        {
            let mut poses = graph.poses.clone();
            let mut at = coordinates(&poses[which]);
            at[axis] += 1e-6;
            poses[which] = of_coordinates(at);
            let change = (edge.residual(&poses) - residual) / 1e-6;
            by.view_mut((0, 3 * which + axis), (3, 1)).copy_from(&change);
        }
        dense += by.transpose() * edge.information * &by;
    }
    for axis in 3 * node..3 * node + 3 {
        dense[(axis, axis)] += 1e12;
    }
    let inverse = dense.try_inverse().unwrap();
    let turn = turned(-graph.poses[node].rotation.angle());
    let others = [0, 12, 29, 31, 59];
    let found = graph.relative_covariances(node, &others);
    for (&other, covariance) in others.iter().zip(&found) {
        let block = inverse.fixed_view::<3, 3>(3 * other, 3 * other);
        let expected = turn * block * turn.transpose();
        assert!((covariance - expected).amax() < 1e-3 * expected.amax(), "{other}: {covariance}");
    }
}
