//! A graph of poses in the plane and measured motions between them, solved by Gauss-Newton with
//! robust weights.

use nalgebra::{Matrix3, Vector3};

use super::{
    rigid::{Motion, coordinates, difference, of_coordinates, turned},
    sparse::{Elimination, System},
};

/// Iterations of a solution, and the step in metres or radians below which it ends.
const ITERATIONS: usize = 30;
const SMALL_STEP: f64 = 1e-5;
/// Squared distance, in standard deviations, beyond which the weight of a doubted measurement falls:
/// chi-squared with three degrees of freedom at 95 %.
const DOUBTED: f64 = 7.8;

/// Information with which a node is fixed.
const FIXED: f64 = 1e12;

/// A measured motion from one node to another.
#[derive(Clone, Debug)]
pub struct Edge {
    /// The node in whose frame the motion is measured.
    pub from: usize,
    /// The other node.
    pub to: usize,
    /// The measured motion: the pose of `to` in the frame of `from`.
    pub motion: Motion,
    /// Information matrix of x, y and turn: the inverse of the covariance.
    pub information: Matrix3<f64>,
    /// Whether the measurement may be wrong: it then has a robust weight.
    pub is_doubted: bool,
}

/// A measured pose of a node.
#[derive(Clone, Debug)]
pub struct Absolute {
    /// The node.
    pub node: usize,
    /// Its measured pose.
    pub pose: Motion,
    /// Information matrix of x, y and heading.
    pub information: Matrix3<f64>,
}

/// An iteration that has begun.
#[derive(Clone, Debug)]
pub struct Iteration {
    elimination: Elimination,
    right: Vec<Vector3<f64>>,
}

/// Nodes and what was measured of them.
#[derive(Clone, Debug, Default)]
pub struct PoseGraph {
    /// The nodes' poses.
    pub poses: Vec<Motion>,
    /// Measurements between nodes.
    pub edges: Vec<Edge>,
    /// Measurements of single nodes. Without any, the first node is fixed.
    pub absolutes: Vec<Absolute>,
}

impl Edge {
    /// By how much the poses differ from the measurement: x, y and turn, in the frame of `from`.
    pub(super) fn residual(&self, poses: &[Motion]) -> Vector3<f64> {
        difference(&self.motion, &poses[self.from].inv_mul(&poses[self.to]))
    }

    /// The squared distance of the poses from the measurement, in standard deviations.
    pub fn distance(&self, poses: &[Motion]) -> f64 {
        let residual = self.residual(poses);
        residual.dot(&(self.information * residual))
    }

    /// The robust weight at a squared distance: dynamic covariance scaling (Agarwal et al., ICRA 2013).
    fn weight(&self, distance: f64) -> f64 {
        if !self.is_doubted {
            return 1.0;
        }
        (2.0 * DOUBTED / (DOUBTED + distance)).min(1.0).powi(2)
    }
}

impl Iteration {
    /// Goes on, for about as many blocks of the matrix as `blocks`. Returns whether it is solved; `None` if it can't be,
    /// since something holds the nodes too loosely. Cost: some 0.3 microseconds a block.
    pub fn go_on(&mut self, blocks: usize) -> Option<bool> {
        self.elimination.go_on(blocks)
    }
}

impl PoseGraph {
    /// Moves the nodes to the poses that fit the measurements best. Returns the number of iterations.
    pub fn solve(&mut self) -> usize {
        for iteration in 1..=ITERATIONS {
            let mut begun = self.begin();
            let is_solved = begun.go_on(usize::MAX).is_some();
            if !is_solved || self.step(begun) < SMALL_STEP {
                return iteration;
            }
        }
        ITERATIONS
    }

    /// Begins an iteration, which can be done in parts.
    pub fn begin(&self) -> Iteration {
        let (system, right) = self.linearised();
        Iteration { elimination: Elimination::new(system), right }
    }

    /// Ends an iteration that is solved: moves the nodes that there were when it began. Returns the greatest step in
    /// metres or radians.
    pub fn step(&mut self, solved: Iteration) -> f64 {
        self.move_by(&solved.elimination.factored().solve(solved.right))
    }

    /// Moves the nodes by steps of x, y and heading. Returns the greatest, in metres or radians.
    pub(super) fn move_by(&mut self, steps: &[Vector3<f64>]) -> f64 {
        let mut greatest = 0.0f64;
        for (pose, step) in self.poses.iter_mut().zip(steps) {
            greatest = greatest.max(step.amax());
            *pose = of_coordinates(coordinates(pose) + step);
        }
        greatest
    }

    /// The normal equations of the steps of all poses (x, y and heading in the map).
    pub(super) fn linearised(&self) -> (System, Vec<Vector3<f64>>) {
        let mut system = System::new(self.poses.len());
        let mut right = vec![Vector3::zeros(); self.poses.len()];
        for edge in &self.edges {
            let (from, to) = (&self.poses[edge.from], &self.poses[edge.to]);
            let residual = edge.residual(&self.poses);
            let distance = residual.dot(&(edge.information * residual));
            let weighted = edge.information * edge.weight(distance);
            let [by_from, by_to] = derivatives(from, to);
            let (left, at) = (by_from.transpose() * weighted, by_to.transpose() * weighted);
            system.add(edge.from, edge.from, &(left * by_from));
            system.add(edge.to, edge.to, &(at * by_to));
            system.add(edge.from, edge.to, &(left * by_to));
            right[edge.from] -= left * residual;
            right[edge.to] -= at * residual;
        }
        for absolute in &self.absolutes {
            let residual = difference(&absolute.pose, &self.poses[absolute.node]);
            system.add(absolute.node, absolute.node, &absolute.information);
            right[absolute.node] -= absolute.information * residual;
        }
        if self.absolutes.is_empty() && !self.poses.is_empty() {
            system.add(0, 0, &(Matrix3::identity() * FIXED));
        }
        (system, right)
    }

    /// The covariances of the poses of `others` relative to `node`: of x, y and turn, in the frame of
    /// `node`. Empty if something holds the nodes too loosely.
    pub fn relative_covariances(&self, node: usize, others: &[usize]) -> Vec<Matrix3<f64>> {
        let mut anchored = self.clone();
        let information = Matrix3::identity() * FIXED;
        anchored.absolutes = vec![Absolute { node, pose: self.poses[node], information }];
        let Some(factored) = anchored.linearised().0.factored() else { return Vec::new() };
        let turn = turned(-self.poses[node].rotation.angle());
        let covariance = |&other: &usize| {
            let mut covariance = Matrix3::zeros();
            for axis in 0..3 {
                let mut right = vec![Vector3::zeros(); self.poses.len()];
                right[other][axis] = 1.0;
                covariance.set_column(axis, &factored.solve(right)[other]);
            }
            turn * covariance * turn.transpose()
        };
        others.iter().map(covariance).collect()
    }
}

/// The derivatives of a residual by the poses of both nodes (x, y and heading in the map).
fn derivatives(from: &Motion, to: &Motion) -> [Matrix3<f64>; 2] {
    let (sin, cos) = (from.rotation.im, from.rotation.re);
    let off = to.translation.vector - from.translation.vector;
    let by_from = Matrix3::new(
        -cos,
        -sin,
        -sin * off.x + cos * off.y,
        sin,
        -cos,
        -cos * off.x - sin * off.y,
        0.0,
        0.0,
        -1.0,
    );
    let by_to = Matrix3::new(cos, sin, 0.0, -sin, cos, 0.0, 0.0, 0.0, 1.0);
    [by_from, by_to]
}
