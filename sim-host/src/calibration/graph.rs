//! The transformation graph: cameras are nodes, transforms between two cameras are edges.

use nalgebra::Isometry3;

use super::pairwise::PairTransform;

/// The transform between cameras i and j: an edge of the graph.
#[derive(Clone, Debug, PartialEq)]
pub struct Edge {
    /// The indices of i and j.
    pub cameras: [usize; 2],
    /// `T_ij` and the landmarks that it comes from.
    pub transform: PairTransform,
}

/// Minimum lever of a rotation's error, in metres.
const LEAST_LEVER_M: f64 = 1.0;

/// The pose of each camera in `R0` along its best path, `T_0k = T_0i T_ij T_jk`, given the pose of
/// the reference camera. `None` for cameras that no path ties to the reference.
///
/// The best path has the least accumulated variance (Dijkstra). The variance of an edge is that of
/// the position of j, plus that of its angles times the square of the mean distance between
/// neighbours: an error of an angle displaces the rest of the path.
pub fn propagate(
    cameras: usize,
    edges: &[Edge],
    reference: usize,
    pose: Isometry3<f64>,
) -> Vec<Option<Isometry3<f64>>> {
    let distances = edges.iter().map(|it| it.transform.t_ij.translation.vector.norm());
    let lever = (distances.sum::<f64>() / edges.len().max(1) as f64).max(LEAST_LEVER_M);
    let mut poses = vec![None; cameras];
    let mut best = vec![f64::INFINITY; cameras];
    let mut tentative = vec![Isometry3::identity(); cameras];
    (best[reference], tentative[reference]) = (0.0, pose);
    loop {
        let open = (0..cameras).filter(|&it| poses[it].is_none() && best[it].is_finite());
        let Some(near) = open.min_by(|&a, &b| best[a].total_cmp(&best[b])) else { return poses };
        let near_pose = tentative[near];
        poses[near] = Some(near_pose);
        for edge in edges {
            let (far, step) = match edge.cameras {
                [i, j] if i == near => (j, edge.transform.t_ij),
                [i, j] if j == near => (i, edge.transform.t_ij.inverse()),
                _ => continue,
            };
            let variance = best[near] + variance(edge, lever);
            if poses[far].is_none() && variance < best[far] {
                (best[far], tentative[far]) = (variance, near_pose * step);
            }
        }
    }
}

fn variance(edge: &Edge, lever_m: f64) -> f64 {
    let diagonal = edge.transform.covariance.diagonal();
    let [angles, position] = [0, 3].map(|from| diagonal.fixed_rows::<3>(from).sum());
    position + lever_m * lever_m * angles
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix6, Vector3};

    fn edge(i: usize, j: usize, x_m: f64, variance: f64) -> Edge {
        let transform = PairTransform {
            t_ij: Isometry3::new(Vector3::new(x_m, 0.0, 0.0), Vector3::zeros()),
            covariance: Matrix6::identity() * variance,
            pairs: Vec::new(),
            rejected: Vec::new(),
            is_labelled: true,
        };
        Edge { cameras: [i, j], transform }
    }

    #[test]
    fn the_best_path_is_taken_in_both_directions_and_untied_cameras_have_none() {
        // The direct edge from 0 to 2 is worse than the way over 1.
        let edges = [
            edge(0, 2, 9.0, 1.0),
            edge(1, 0, -1.0, 0.1),
            edge(1, 2, 1.0, 0.1),
            edge(3, 4, 1.0, 0.1),
        ];
        let start = Isometry3::new(Vector3::new(0.0, 5.0, 0.0), Vector3::z());
        let poses = propagate(5, &edges, 0, start);
        let expected = start * Isometry3::translation(2.0, 0.0, 0.0);
        assert!((poses[2].unwrap().to_homogeneous() - expected.to_homogeneous()).norm() < 1e-12);
        assert!(poses[1].is_some() && poses[3].is_none() && poses[4].is_none());
    }
}
