//! The graph of a chain of submaps.

use nalgebra::{Matrix3, Vector3};

use super::{
    chain::Chain,
    cloud::Cloud,
    loops::{Loop, Loops, align},
    pose_graph::{Edge, PoseGraph},
    refinement::refine,
    rigid::Motion,
    view::View,
};

/// Submaps with fewer submaps between them than this share views, and are not matched.
const APART: usize = 3;
/// Distance of two anchors at which their submaps may overlap, in metres.
const NEAR_M: f64 = 4.0;
/// Maximum number of submaps that a complete submap is matched with: the nearest ones.
const MATCHED: usize = 20;
/// Search window of a match: a fixed part, and the greatest, in metres and radians.
const WINDOW: [(f64, f64); 2] = [(0.15, 0.05), (5.0, 0.8)];
/// Information with which the last refinement holds each view where it is: 5 cm and 2 degrees.
const HOLD: (f64, f64) = (400.0, 1_000.0);

/// Numbers about a graph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GraphCounts {
    /// Views.
    pub views: usize,
    /// Views that were placed by odometry alone.
    pub unmatched: usize,
    /// Submaps.
    pub submaps: usize,
    /// Matches of two submaps that were found.
    pub matches: usize,
    /// The matches that are consistent, and hold the graph.
    pub consistent: usize,
}

/// Finds the poses of a robot's views: add them in order of time, then [finish](Self::finish).
#[derive(Debug, Default)]
pub struct GraphMapper {
    chain: Chain,
    loops: Loops,
    graph: PoseGraph,
}

impl GraphMapper {
    /// Adds a view. Cost: some milliseconds; when it completes a submap, some 100 ms.
    pub fn add(&mut self, view: View) {
        let is_first = self.chain.views.is_empty();
        let is_complete = self.chain.add(view);
        if is_first {
            self.graph.poses.push(Motion::identity());
            self.loops.extend(None);
        }
        if is_complete {
            self.extend();
            self.close_loops(self.chain.submaps.len() - 2);
        }
    }

    /// Completes the last submap, and returns the poses of all views, in the frame of the first.
    pub fn finish(mut self) -> (Vec<(View, Motion)>, GraphCounts) {
        self.chain.finish();
        if let Some(last) = self.chain.submaps.len().checked_sub(1) {
            self.close_loops(last);
        }
        let counts = self.counts();
        let mut poses = self.poses();
        self.refine_views(&mut poses);
        (self.chain.views.into_iter().zip(poses).collect(), counts)
    }

    /// Numbers about the graph.
    pub fn counts(&self) -> GraphCounts {
        GraphCounts {
            views: self.chain.views.len(),
            unmatched: self.chain.unmatched,
            submaps: self.chain.submaps.len(),
            matches: self.loops.all.len(),
            consistent: self.loops.accepted.len(),
        }
    }

    /// The poses of all views at the solved poses of their submaps' anchors.
    pub fn poses(&self) -> Vec<Motion> {
        let mut poses = vec![Motion::identity(); self.chain.views.len()];
        for (submap, anchor) in self.chain.submaps.iter().zip(&self.graph.poses) {
            for placed in submap.own_views() {
                poses[placed.view] = anchor * placed.pose;
            }
        }
        poses
    }

    /// Adds the newest submap's anchor to the graph.
    fn extend(&mut self) {
        let (Some(step), Some(last)) = (self.chain.steps.last(), self.graph.poses.last()) else {
            return;
        };
        let from = self.graph.poses.len() - 1;
        let pose = last * step.motion;
        self.graph.poses.push(pose);
        self.graph.edges.push(Edge {
            from,
            to: from + 1,
            motion: step.motion,
            information: step.information(),
            is_doubted: false,
        });
        self.loops.extend(Some(step));
    }

    /// Matches a complete submap with all earlier ones that may overlap it, and solves the graph.
    fn close_loops(&mut self, number: usize) {
        let others: Vec<usize> = (0..(number + 1).saturating_sub(APART)).collect();
        let covariances = self.graph.relative_covariances(number, &others);
        let mut near: Vec<(f64, usize, Motion, (f64, f64))> = Vec::new();
        for (&other, covariance) in others.iter().zip(&covariances) {
            let guess = self.graph.poses[number].inv_mul(&self.graph.poses[other]);
            let position = covariance[(0, 0)].max(covariance[(1, 1)]).sqrt();
            let turn = covariance[(2, 2)].sqrt();
            let off = guess.translation.vector.norm();
            if off < NEAR_M + 2.5 * position {
                let [least, most] = WINDOW;
                let half_m = (least.0 + 3.0 * position).min(most.0);
                let half_rad = (least.1 + 3.0 * turn).min(most.1);
                near.push((off - position, other, guess, (half_m, half_rad)));
            }
        }
        near.sort_by(|one, other| one.0.total_cmp(&other.0));
        let before = self.loops.all.len();
        for (_, other, guess, window) in near.into_iter().take(MATCHED) {
            let (submap, its) = (&self.chain.submaps[number], &self.chain.submaps[other]);
            if let Some(measured) = align(submap, its, &guess, window) {
                self.loops.push(Loop { from: number, to: other, measured });
            }
        }
        if self.loops.all.len() > before {
            self.solve();
        }
    }

    fn solve(&mut self) {
        self.loops.choose();
        self.graph.edges.retain(|edge| !edge.is_doubted);
        let accepted = self.loops.accepted.iter().map(|&index| self.loops.all[index].edge());
        self.graph.edges.extend(accepted);
        self.graph.solve();
    }

    /// Refines the pose of each view against what all others saw: submaps are rigid, but their views
    /// are not quite where they were placed.
    fn refine_views(&self, poses: &mut [Motion]) {
        let mut cloud = Cloud::default();
        let mut starts = vec![0];
        for (view, pose) in self.chain.views.iter().zip(poses.iter()) {
            cloud.extend(view.surfels.iter().map(|surfel| surfel.moved(pose)));
            starts.push(cloud.surfels().len() as u32);
        }
        let hold = Matrix3::from_diagonal(&Vector3::new(HOLD.0, HOLD.0, HOLD.1));
        for ((view, pose), ends) in self.chain.views.iter().zip(poses).zip(starts.windows(2)) {
            cloud.hide(ends[0]..ends[1]);
            let before = *pose;
            if let Some(refined) = refine(&cloud, &view.surfels, &before, Some((&before, &hold))) {
                *pose = refined.motion;
            }
        }
    }
}
