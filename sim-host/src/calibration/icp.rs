//! The iterated closest point algorithm between the landmarks of two cameras, trimmed: a landmark that has
//! no partner within the gate doesn't count.

use nalgebra::{Isometry3, Point3};

use super::{
    observations::Landmark,
    tie::{Tie, weighted},
};

/// Maximum number of iterations.
const ITERATIONS: usize = 50;
/// Each iteration narrows the gate by this factor until it has its final width.
const NARROWING: f64 = 0.6;

/// Landmarks of two cameras, each with its index in its camera.
pub(super) type Sets<'a> = [&'a [(usize, &'a Landmark)]; 2];

/// The pairs of landmarks that ICP ends with, starting from `start`; `None` if fewer than three
/// remain or the pairs are on a line.
///
/// Both steps are the paper's: each landmark of i is matched with the closest one of j (and the
/// other way round), then `T_ij` is computed by least squares. It ends when the mean distance
/// changes by less than `convergence_m`, the paper's `s`. `wide` and `gate` are the first and
/// the final maximum distances in standard deviations.
pub(super) fn trimmed_icp(
    start: Isometry3<f64>,
    sets: Sets<'_>,
    [wide, gate]: [f64; 2],
    convergence_m: f64,
) -> Option<Vec<Tie>> {
    let (mut t_ij, mut mean, mut width) = (start, f64::INFINITY, wide);
    for _ in 0..ITERATIONS {
        let ties = closest(&t_ij, sets, width);
        t_ij = weighted(&ties)?;
        let distances = ties.iter().map(|it| it.residual(&t_ij).norm());
        let next = distances.sum::<f64>() / ties.len() as f64;
        let is_final = width <= gate;
        if is_final && (next - mean).abs() < convergence_m {
            return Some(ties);
        }
        (mean, width) = (next, (width * NARROWING).max(gate));
    }
    Some(closest(&t_ij, sets, gate)).filter(|ties| ties.len() >= 3)
}

/// Pairs of landmarks that are each other's closest, within the gate.
fn closest(t_ij: &Isometry3<f64>, [first, second]: Sets<'_>, gate: f64) -> Vec<Tie> {
    let ours: Vec<Point3<f64>> = first.iter().map(|it| it.1.position).collect();
    let theirs: Vec<Point3<f64>> = second.iter().map(|it| t_ij * it.1.position).collect();
    let nearest = |point: &Point3<f64>, among: &[Point3<f64>]| {
        let distance = |it: usize| (among[it] - point).norm_squared();
        (0..among.len()).min_by(|&a, &b| distance(a).total_cmp(&distance(b)))
    };
    let ties = ours.iter().enumerate().filter_map(|(i, point)| {
        let j = nearest(point, &theirs)?;
        if nearest(&theirs[j], &ours) != Some(i) {
            return None;
        }
        let tie = Tie::new([first[i].0, second[j].0], [first[i].1, second[j].1]);
        (tie.distance2(t_ij) <= gate * gate).then_some(tie)
    });
    ties.collect()
}
