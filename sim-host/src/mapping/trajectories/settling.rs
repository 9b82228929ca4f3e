//! Takes the oldest pieces out of the graph.

use std::collections::BTreeSet;

use ubimap_protocol::units::RobotId;

use super::{Overlaps, Trajectories};
use crate::mapping::submaps::{Absolute, Edge, turned};

/// Maximum number of pieces that can move; 8 robots make as many in 15 minutes.
const MOST: usize = 4_000;
/// Number of pieces that are settled at once.
const AT_ONCE: usize = 200;

impl Trajectories {
    /// Settles the oldest pieces, if there are too many: what they say of the map stays as it is,
    /// and what they say of the others becomes a measurement of these. Returns whether there were. Their ground must be
    /// [where they are](Self::placement).
    pub(super) fn settle(&mut self) -> bool {
        if self.pieces.len() < MOST {
            return false;
        }
        for robot in self.robots.keys().copied().collect::<Vec<_>>() {
            let Some(trajectory) = self.robots.get(&robot) else { continue };
            // The newest piece of a robot that has not moved for long stays among the settled ones; it begins anew.
            let old = trajectory.pieces.partition_point(|it| *it < AT_ONCE);
            let mut settled = trajectory.settled.clone();
            trajectory.pieces[..old].iter().for_each(|&it| self.place(it, &mut settled));
            if let Some(&first) = trajectory.pieces.get(old) {
                self.pieces[first].step = self.believed(first).covariance;
            }
            if let Some(trajectory) = self.robots.get_mut(&robot) {
                trajectory.settled = settled;
                trajectory.pieces.drain(..old);
                trajectory.pieces.iter_mut().for_each(|it| *it -= AT_ONCE);
                trajectory.since.take_if(|_| trajectory.pieces.is_empty());
            }
        }
        self.robots.retain(|_, it| !it.is_forgotten || !it.pieces.is_empty());
        let edges: Vec<Edge> = self.matches.drain(..AT_ONCE).flatten().collect();
        let mut matches = core::mem::take(&mut self.matches);
        matches.iter_mut().for_each(|it| it.retain_mut(|edge| self.keep(edge)));
        self.matches = matches;
        for mut edge in edges {
            if self.keep(&mut edge) {
                self.matches[edge.from].push(edge);
            }
        }
        let mut steps = core::mem::take(&mut self.steps);
        steps.retain_mut(|edge| self.keep(edge));
        self.steps = steps;
        self.absolutes.retain_mut(|it| {
            let is_kept = it.node >= AT_ONCE;
            it.node = it.node.saturating_sub(AT_ONCE);
            is_kept
        });
        self.absolutes.append(&mut self.held);
        self.pieces.drain(..AT_ONCE);
        self.placed.drain(..AT_ONCE);
        self.graph.poses.drain(..AT_ONCE);
        self.waiting = self.waiting.iter().filter_map(|it| it.checked_sub(AT_ONCE)).collect();
        (self.next, self.again) = (0, 0);
        self.has_settled = true;
        let placed: Vec<usize> = (0..self.pieces.len())
            .filter(|it| self.overlaps.placed(it + AT_ONCE).is_some())
            .collect();
        self.overlaps = Overlaps::default();
        placed.into_iter().for_each(|it| self.find(it));
        true
    }

    /// Whether pieces were settled since the last call.
    pub fn take_settled(&mut self) -> bool {
        core::mem::take(&mut self.has_settled)
    }

    /// Forgets the settled corrections of a robot in whose time none of its cells was drawn;
    /// `seconds` are those in which some were.
    pub fn thin(&mut self, robot: RobotId, seconds: &BTreeSet<u32>) {
        let Some(trajectory) = self.robots.get_mut(&robot) else { return };
        let corrections = &mut trajectory.settled.corrections;
        let mut ends =
            corrections.iter().skip(1).map(|it| it.since).collect::<Vec<_>>().into_iter();
        corrections.retain(|it| match ends.next() {
            Some(end) => seconds.range(it.since..end).next().is_some(),
            None => true,
        });
        corrections.dedup_by_key(|it| it.by);
    }

    /// Whether an edge stays between pieces that can move. One that leads to a settled piece holds the other.
    fn keep(&mut self, edge: &mut Edge) -> bool {
        let poses = &self.graph.poses;
        let (from, to) = (edge.from, edge.to);
        let held = match (from < AT_ONCE, to < AT_ONCE) {
            (true, false) => Some((to, poses[from] * edge.motion, poses[from].rotation.angle())),
            (false, true) => {
                let pose = poses[to] * edge.motion.inverse();
                Some((from, pose, pose.rotation.angle()))
            }
            _ => None,
        };
        if let Some((node, pose, angle)) = held {
            let turn = turned(angle);
            let information = turn * edge.information * turn.transpose();
            self.held.push(Absolute { node: node - AT_ONCE, pose, information });
        }
        (edge.from, edge.to) = (from.saturating_sub(AT_ONCE), to.saturating_sub(AT_ONCE));
        from >= AT_ONCE && to >= AT_ONCE
    }
}
