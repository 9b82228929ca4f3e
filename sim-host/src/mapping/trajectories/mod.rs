//! Where all robots were: their trajectories, held together by what they saw.
//!
//! A trajectory is cut into short pieces, which are rigid. From piece to piece a robot's motion is known; where cameras
//! saw the robot, so is its pose; pieces from which the same surfaces were seen are matched with each other; and where
//! most walls are along two directions, these tell headings. All of this is one [`PoseGraph`], solved with robust
//! weights. Whatever robots have drawn, they drew at the poses that they believed in then; where the graph puts the
//! pieces now is where that belongs ([`PlacedLayer`](super::PlacedLayer)).
//!
//! The newest 4,000 pieces can move; the corrections of older ones are settled. Units are metres and radians.
//! Deterministic.

mod certainty;
mod compass;
mod matches;
mod overlaps;
mod piece;
mod settling;
mod step;

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use nalgebra::{Matrix3, Vector3};
use ubimap_protocol::units::{Millimetres, Pose, RobotId};

use self::{
    compass::Compass,
    matches::{Matches, covariance},
    overlaps::Overlaps,
    piece::Piece,
};
use super::{
    placed_layer::{Correction, Placement},
    submaps::{
        self, Absolute, Edge, Iteration, Motion, PoseGraph, View, is_within, refine, turned,
    },
};

pub use step::Step;

/// Views of a piece.
const VIEWS: usize = 2;
/// A robot that has moved less than this since its last view sees nothing new: in metres and radians.
const STOOD: (f64, f64) = (0.03, 0.05);
/// Neighbouring pieces of one trajectory share their surfaces, and the errors of their steps are small: pieces with
/// fewer than this between them are not matched.
const APART: usize = 3;
/// Maximum number of others that a piece is matched with, and is tried with: those that share most of its ground.
const MATCHED: usize = 12;
const TRIED: usize = 4 * MATCHED;
/// Number of earlier pieces that are matched again whenever a piece is complete.
const AGAIN: usize = 2;
/// Minimum number of squares that two pieces share.
const LEAST_SHARED: usize = 3;
/// Minimum number of surfels in a match.
const LEAST_SURFELS: usize = 12;
/// Minimum share of surfels on surfaces, among those beside what the other piece saw.
const LEAST_SHARE: f64 = 0.6;
/// A match that moves the pieces by more than this found something else: in metres and radians.
const FARTHEST: (f64, f64) = (0.5, 0.2);
/// What moves by less than this stays where it is in the map: a quarter of a cell, and that at 3.5 m.
const STILL: (f64, f64) = (0.012, 0.003_5);
/// What was drawn from a pose that was off by less than this stays where it was drawn: a cell, and
/// that at 3 m.
const RIGHT: (f64, f64) = (0.05, 0.017_5);
/// Deviations with which cameras see a robot's pose.
const SEEN: [f64; 3] = [0.02, 0.02, 0.01];
/// Deviations of the first pose of a robot.
const FIRST: [f64; 3] = [0.1, 0.1, 0.05];
/// Factor on the deviations of a step to tell whether a match is plausible.
const WARY: f64 = 2.0;
/// Distance and turn within which a piece is still where it was found.
const FOUND: (f64, f64) = (0.1, 0.05);
/// Number of blocks of the graph's matrix that are worked on at a time: some 10 ms; few in tests, so that parts are tested.
const BLOCKS: usize = if cfg!(test) { 1_000 } else { 20_000 };

/// All robots' trajectories.
#[derive(Debug, Default)]
pub struct Trajectories {
    /// Those that can move, in the order in which they began.
    pieces: Vec<Piece>,
    robots: BTreeMap<RobotId, Trajectory>,
    /// The pieces' poses, which are those of their first views.
    graph: PoseGraph,
    /// Where the map has the pieces.
    placed: Vec<Motion>,
    steps: Vec<Edge>,
    /// What was measured of single pieces.
    absolutes: Vec<Absolute>,
    /// The walls' directions, which are learnt anew whenever the server starts.
    compass: Compass,
    /// The matches of each piece with others.
    matches: Vec<Vec<Edge>>,
    overlaps: Overlaps,
    /// Complete pieces that are not matched yet.
    waiting: VecDeque<usize>,
    /// The next piece to match again.
    next: usize,
    /// What settled pieces say of the others, while they are settled.
    held: Vec<Absolute>,
    /// Number of pieces that are still to be matched again.
    again: usize,
    /// The iteration of the graph that has begun. One is enough each time, since it goes on from where it was.
    solving: Option<Iteration>,
    /// Whether anything was added since the last iteration began.
    is_unsolved: bool,
    has_settled: bool,
}

/// A robot's trajectory.
#[derive(Debug, Default)]
struct Trajectory {
    /// What pieces say that can't move any more.
    settled: Placement,
    /// In order of time.
    pieces: Vec<usize>,
    /// The motion since the last view, while the robot has not moved far enough for another.
    since: Option<Step>,
    /// Whether it goes with its last piece.
    is_forgotten: bool,
}

impl Trajectories {
    /// Restores what was known of a robot at an earlier time.
    pub fn restore(&mut self, robot: RobotId, placement: Placement) {
        self.robots.entry(robot).or_default().settled = placement;
    }

    /// Forgets a robot that is gone and has drawn nothing. Its pieces go when they are old.
    pub fn forget(&mut self, robot: RobotId) {
        let Some(trajectory) = self.robots.get_mut(&robot) else { return };
        trajectory.is_forgotten = true;
        if trajectory.pieces.is_empty() {
            self.robots.remove(&robot);
        }
    }

    /// Forgets what ground a robot has seen, and what was learnt of the walls' directions: its sensor was not where it was
    /// believed to be.
    pub fn void_ground(&mut self, robot: RobotId) {
        self.compass = Compass::default();
        self.pieces.iter_mut().for_each(|piece| piece.heading = None);
        let Some(trajectory) = self.robots.get_mut(&robot) else { return };
        trajectory.settled.ground.clear();
        trajectory.pieces.iter().for_each(|&number| self.pieces[number].void_ground());
    }

    /// Adds a view of a robot. `pose` is where the robot is believed to be, `step` is how it got there from its last
    /// view, if that is known, and `seen` is the pose in which cameras saw it.
    pub fn add(
        &mut self,
        robot: RobotId,
        view: &View,
        pose: Motion,
        step: Option<Step>,
        seen: Option<Motion>,
    ) {
        let trajectory = self.robots.entry(robot).or_default();
        trajectory.is_forgotten = false;
        let since = trajectory.since.take();
        let Some(&last) = trajectory.pieces.last() else {
            let node = self.pieces.len();
            self.absolutes.push(Absolute { node, pose, information: information(FIRST) });
            return self.begin(robot, view, pose, seen, covariance(FIRST));
        };
        let piece = &mut self.pieces[last];
        let step = match (since, step) {
            (Some(since), Some(step)) => Some(since.then(&step)),
            (None, Some(step)) => Some(step),
            (_, None) => None,
        };
        // Where cameras see a robot, its odometry is corrected all the time, and by little.
        let is_known = step.is_some() || piece.is_seen && seen.is_some();
        let step = step.unwrap_or_else(|| Step::reported(&piece.last().reported, &view.reported));
        let is_same = is_known && !piece.is_closed;
        let has_stood = is_within(&step.by, STOOD);
        if is_same && (has_stood || piece.views.len() < VIEWS) {
            let at = piece.last().at * step.by;
            if has_stood {
                let is_noted = piece.stand(view, at, seen.is_some());
                self.robots.entry(robot).or_default().since = (!is_noted).then_some(step);
            } else {
                piece.add(view, at, seen.is_some());
            }
            if let Some(seen) = seen.filter(|_| !piece.is_seen) {
                piece.is_seen = true;
                self.see(last, seen * at.inverse());
            }
            return;
        }
        let before = piece.last().at;
        piece.is_closed = true;
        if piece.is_seen {
            self.compass.learn(&piece.directions, self.graph.poses[last].rotation.angle());
        }
        self.waiting.push_back(last);
        let turn = turned(before.rotation.angle());
        self.steps.push(Edge {
            from: last,
            to: self.pieces.len(),
            motion: before * step.by,
            information: turn * information(step.deviations) * turn.transpose(),
            is_doubted: step.is_doubted,
        });
        let spread = turn * covariance(step.deviations.map(|it| WARY * it)) * turn.transpose();
        self.begin(robot, view, pose, seen, spread);
    }

    /// Begins anew where a robot was found that did not know where it was.
    pub fn found(&mut self, robot: RobotId, view: &View, pose: Motion) {
        let step = Step::unknown(self.newest(robot).unwrap_or(pose).inv_mul(&pose));
        let trajectory = self.robots.entry(robot).or_default();
        trajectory.since = None;
        if let Some(&last) = trajectory.pieces.last() {
            self.pieces[last].is_closed = true;
        }
        self.add(robot, view, pose, Some(step), None);
    }

    fn begin(
        &mut self,
        robot: RobotId,
        view: &View,
        pose: Motion,
        seen: Option<Motion>,
        step: Matrix3<f64>,
    ) {
        let node = self.pieces.len();
        self.pieces.push(Piece::new(robot, view, step, seen.is_some()));
        self.matches.push(Vec::new());
        self.graph.poses.push(pose);
        self.placed.push(pose);
        self.robots.entry(robot).or_default().pieces.push(node);
        self.is_unsolved = true;
        if let Some(seen) = seen {
            self.see(node, seen);
        }
    }

    fn see(&mut self, node: usize, pose: Motion) {
        self.pieces[node].held = Some(covariance(SEEN));
        self.absolutes.push(Absolute { node, pose, information: information(SEEN) });
        self.is_unsolved = true;
    }

    /// Matches a piece that is complete, or one of the others again, if [there is something to
    /// match](Self::is_matching). Cost: some milliseconds.
    pub fn advance(&mut self) {
        if self.again > 0 {
            self.again -= 1;
            self.next = (self.next + 1) % self.pieces.len();
            if self.overlaps.placed(self.next).is_some() {
                self.relate(self.next);
            }
        } else if let Some(piece) = self.waiting.pop_front() {
            self.again = AGAIN;
            self.is_unsolved = true;
            self.relate(piece);
        }
    }

    /// Whether [`Self::advance`] has something to match.
    pub fn is_matching(&self) -> bool {
        !self.waiting.is_empty() || self.again > 0
    }

    /// Whether there is something new to solve.
    pub fn is_unsolved(&self) -> bool {
        self.is_unsolved
    }

    /// Whether [`Self::solve`] has begun, and has to go on.
    pub fn is_solving(&self) -> bool {
        self.solving.is_some()
    }

    /// Notes the pose of a robot's newest view by a match with the whole map, as a hypothesis for [`Self::advance`].
    pub fn suggest(&mut self, robot: RobotId, pose: Motion) {
        let Some(trajectory) = self.robots.get(&robot) else { return };
        let Some(&last) = trajectory.pieces.last() else { return };
        let since = trajectory.since.map_or_else(Motion::identity, |since| since.by);
        let piece = &mut self.pieces[last];
        piece.suggested = Some(pose * (piece.last().at * since).inverse());
    }

    /// Matches a piece with those that saw the same ground, where it is or where the whole map has suggested, whichever has
    /// more support. One whose pose cameras saw is as good as it gets; it holds others in place.
    fn relate(&mut self, number: usize) {
        let here = self.graph.poses[number];
        let suggested = self.pieces[number].suggested.take();
        if self.pieces[number].is_seen {
            return self.find(number);
        }
        let there = suggested.filter(|it| !is_within(&here.inv_mul(it), FOUND));
        let there = there.map(|there| (there, self.matches_at(number, &there)));
        let mut best = (here, self.matches_at(number, &here));
        let support = self.support(number, &best.1);
        if let Some(there) = there.filter(|(_, it)| self.support(number, it) > support) {
            best = there;
        }
        let (pose, found) = best;
        let piece = &mut self.pieces[number];
        piece.heading = self.compass.heading(&piece.directions, pose.rotation.angle());
        piece.held = found.covariance();
        self.matches[number] = found.edges;
    }

    /// The matches of a piece at about a pose with those that saw the same ground.
    fn matches_at(&mut self, number: usize, pose: &Motion) -> Matches {
        self.overlaps.place(number, &self.pieces[number].cloud, pose);
        let piece = &self.pieces[number];
        let poses = &self.graph.poses;
        let predicted = self.predicted(number);
        let mut found = Matches { predicted, edges: Vec::new(), covariances: Vec::new() };
        let mut refused = 0;
        let others = self.overlaps.of(number).take_while(|(_, shared)| *shared >= LEAST_SHARED);
        for (other, _) in others.take(TRIED) {
            if found.edges.len() >= MATCHED || refused >= MATCHED {
                break;
            }
            let its = &self.pieces[other];
            if its.robot == piece.robot && self.between(number, other) < APART {
                continue;
            }
            let guess = poses[other].inv_mul(pose);
            let surfels = piece.cloud.surfels();
            let Some(refined) = refine(&its.cloud, surfels, &guess, None) else { continue };
            let beside =
                surfels.iter().filter(|it| its.cloud.is_beside(&it.moved(&refined.motion)));
            let least = (LEAST_SHARE * beside.count() as f64).max(LEAST_SURFELS as f64);
            let is_same = is_within(&guess.inv_mul(&refined.motion), FARTHEST);
            if !is_same || (refined.matched as f64) < least {
                continue;
            }
            let plausible = self.plausible((number, &found.predicted), other, &refined);
            refused += usize::from(plausible.is_none());
            if let Some((its, information)) = plausible.zip(refined.covariance.try_inverse()) {
                let motion = refined.motion;
                found.edges.push(Edge {
                    from: other,
                    to: number,
                    motion,
                    information,
                    is_doubted: true,
                });
                found.covariances.push(its);
            }
        }
        found
    }

    /// Number of steps between two pieces of one robot.
    fn between(&self, one: usize, other: usize) -> usize {
        let pieces = &self.robots[&self.pieces[one].robot].pieces;
        let place = |node: usize| pieces.partition_point(|it| *it < node);
        place(one).abs_diff(place(other))
    }

    /// Notes where a piece is, for others that overlap it.
    fn find(&mut self, number: usize) {
        let pose = self.graph.poses[number];
        self.overlaps.place(number, &self.pieces[number].cloud, &pose);
    }

    /// Solves the graph in parts, if something is new, and settles the oldest pieces first, if there are too many. The
    /// last part returns the robots whose [placement](Self::placement) has changed. Cost: some 10 ms.
    pub fn solve(&mut self) -> BTreeSet<RobotId> {
        let Some(mut iteration) = self.solving.take() else {
            if !self.settle() && core::mem::take(&mut self.is_unsolved) {
                self.graph.edges.clear();
                self.graph.edges.extend(self.steps.iter().cloned());
                self.graph.edges.extend(self.matches.iter().flatten().cloned());
                self.graph.absolutes.clone_from(&self.absolutes);
                let headings = self.headings().collect::<Vec<_>>();
                self.graph.absolutes.extend(headings);
                self.solving = Some(self.graph.begin());
            }
            return BTreeSet::new();
        };
        match iteration.go_on(BLOCKS) {
            Some(true) => {
                self.graph.step(iteration);
                return self.put();
            }
            Some(false) => self.solving = Some(iteration),
            None => log::debug!("nothing holds some of the robots' trajectories"),
        }
        BTreeSet::new()
    }

    /// The headings of pieces by the walls' directions, as measurements of these alone.
    fn headings(&self) -> impl Iterator<Item = Absolute> {
        (0..).zip(&self.pieces).filter_map(|(node, piece)| {
            let (heading, deviation) = piece.heading?;
            let pose = Motion::new(self.graph.poses[node].translation.vector, heading);
            let information = Matrix3::from_diagonal(&Vector3::z()) / (deviation * deviation);
            Some(Absolute { node, pose, information })
        })
    }

    /// Takes over where the pieces are now. Returns the robots of those that have moved.
    fn put(&mut self) -> BTreeSet<RobotId> {
        let mut moved = BTreeSet::new();
        for number in 0..self.pieces.len() {
            let pose = self.graph.poses[number];
            let found = self.overlaps.placed(number);
            if found.is_some_and(|found| !is_within(&found.inv_mul(&pose), FOUND)) {
                self.find(number);
            }
            let is_new = !core::mem::replace(&mut self.pieces[number].is_in_map, true);
            if is_new || !is_within(&self.placed[number].inv_mul(&pose), STILL) {
                self.placed[number] = pose;
                self.pieces[number].is_put = false;
                moved.insert(self.pieces[number].robot);
            }
        }
        moved
    }

    /// Where a robot made its newest view, as of the last [`Self::solve`].
    pub fn newest(&self, robot: RobotId) -> Option<Motion> {
        let trajectory = self.robots.get(&robot)?;
        let &last = trajectory.pieces.last()?;
        let since = trajectory.since.map_or_else(Motion::identity, |since| since.by);
        Some(self.graph.poses[last] * self.pieces[last].last().at * since)
    }

    /// What is known of where a robot was, as of the last [`Self::solve`]. Cost: some 0.2 ms for each piece that has moved.
    pub fn placement(&mut self, robot: RobotId, resolution: Millimetres) -> Placement {
        for &number in self.robots.get(&robot).map_or(&[][..], |it| &it.pieces) {
            self.pieces[number].put(&self.placed[number], resolution);
        }
        let Some(trajectory) = self.robots.get(&robot) else { return Placement::default() };
        let mut placement = trajectory.settled.clone();
        trajectory.pieces.iter().for_each(|&number| self.place(number, &mut placement));
        placement
    }

    /// Adds what a piece says.
    fn place(&self, number: usize, placement: &mut Placement) {
        self.correct(number, &mut placement.corrections);
        for (&id, seen) in &self.pieces[number].ground {
            let ground = placement.ground.entry(id).or_default();
            ground.iter_mut().zip(seen).for_each(|(row, more)| *row |= more);
        }
    }

    /// Adds the corrections of a piece.
    fn correct(&self, number: usize, corrections: &mut Vec<Correction>) {
        for view in &self.pieces[number].views {
            let at = self.placed[number] * view.at;
            let is_right = view.is_seen || is_within(&view.reported.inv_mul(&at), RIGHT);
            let by = if is_right {
                Pose::default()
            } else {
                submaps::pose(&(at * view.reported.inverse()))
            };
            let since = (view.time.micros() / 1_000_000) as u32;
            match corrections.last_mut() {
                Some(last) if last.by == by => {}
                Some(last) if last.since == since => last.by = by,
                _ => corrections.push(Correction { since, by }),
            }
        }
    }
}

fn information(deviations: [f64; 3]) -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::from(deviations.map(|it| 1.0 / (it * it))))
}

#[cfg(test)]
mod tests;
