//! The graph of a chain of submaps.

use log::debug;

use super::{
    chain::Chain,
    loops::{Loop, Loops, align},
    pose_graph::{Edge, PoseGraph},
    registration::register,
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
        let columns = register(&mut self.chain.views, &mut poses);
        debug!("readings are {:.2} of a column nearer than assumed", columns.nearer());
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
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;

    use super::{
        super::tests::{seen, walls},
        *,
    };

    /// Two rounds through a corridor, with odometry that turns by 4 degrees too much each metre.
    #[test]
    fn rounds_through_a_corridor_end_where_they_began() {
        let walls = walls();
        let (mut truth, mut reported) = (Motion::identity(), Motion::identity());
        let mut mapper = GraphMapper::default();
        let mut truths = Vec::new();
        for (index, turn) in (0..2)
            .flat_map(|_| {
                [40, 28, 40, 28].into_iter().flat_map(|count| {
                    (0..count + 6).map(move |step| if step < count { 0.0 } else { 15.0f64 })
                })
            })
            .enumerate()
        {
            mapper.add(seen(64, &walls, &truth, &reported, index as u64));
            truths.push(truth);
            let (way, slip) = if turn == 0.0 { (0.25, 1.0f64) } else { (0.0, 0.5) };
            truth *= Motion::new(Vector2::new(way, 0.0), turn.to_radians());
            let turned = (turn + slip).to_radians();
            reported *= Motion::new(Vector2::new(way * 1.02, 0.0), turned);
        }
        let drift = (reported.translation.vector - truth.translation.vector).norm();
        let (views, counts) = mapper.finish();
        let off = views.iter().zip(&truths).map(|((_, pose), truth)| {
            let off = truths[0].inv_mul(truth).inv_mul(&(views[0].1.inv_mul(pose)));
            (off.translation.vector.norm(), off.rotation.angle().abs())
        });
        let worst = off.fold((0.0, 0.0), |(a, b): (f64, f64), (c, d)| (a.max(c), b.max(d)));
        println!("{counts:?}; odometry off by {drift:.2} m, the graph by at most {worst:?}");
        assert!(drift > 3.0, "{drift}");
        assert!(counts.consistent >= 5, "{counts:?}");
        assert!(worst.0 < 0.1 && worst.1 < 0.01, "{worst:?}");
    }
}
