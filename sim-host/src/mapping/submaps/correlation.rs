//! Correlative matching with branch and bound: the best motions in a window, over all turns and
//! translations (Olson, ICRA 2009; Hess et al., ICRA 2016).
//!
//! The turned points are a [`Shape`]; its agreement with the reference's plane is counted 32 cells at
//! a time. Coarser planes have a cell set if any cell of a block is set, so that their agreement
//! bounds that of all translations in the block.

use core::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;

use nalgebra::{UnitComplex, Vector2};

use super::{
    bit_plane::{BitPlane, Shape},
    cloud::Surfel,
    rigid::Motion,
};

/// Levels of the pyramid: blocks of 1, 2, 4 and 8 cells.
const LEVELS: usize = 4;
/// Turn between two different motions, in radians.
const APART_RAD: f64 = 0.2;

/// The planes of a reference, from fine to coarse.
#[derive(Clone, Debug)]
pub struct Pyramid {
    side_m: f64,
    planes: Vec<BitPlane>,
}

/// Where to search.
#[derive(Clone, Copy, Debug)]
pub struct Window {
    /// The middle.
    pub middle: Motion,
    /// Half of the width and height in metres.
    pub half_m: f64,
    /// Half of the range of turns in radians.
    pub half_rad: f64,
    /// Step of turns in radians.
    pub step_rad: f64,
}

/// A motion and the share of points that meet a surface there, from 0 to 1.
#[derive(Clone, Copy, Debug)]
pub struct Candidate {
    /// The motion from the points' frame into that of the reference.
    pub motion: Motion,
    /// The share of the points' cells that are set in the reference.
    pub score: f64,
}

impl Pyramid {
    /// The pyramid of the surfaces through some points, with cells of `side_m` metres. A point meets a
    /// surface if it is in the same cell or in one of the eight around it.
    pub fn of(surfels: &[Surfel], side_m: f64) -> Self {
        let cells: Vec<_> = surfels.iter().map(|surfel| cell(surfel.at, side_m)).collect();
        let mut planes = vec![BitPlane::of(&cells).spread((-1, -1), (1, 1))];
        for level in 1..LEVELS {
            // The block of a level is the union of four blocks of the finer level.
            let half = 1 << (level - 1);
            let coarser = planes.last().map(|finer| finer.spread((0, 0), (half, half)));
            planes.extend(coarser);
        }
        Self { side_m, planes }
    }

    /// The motions of the window with the highest scores, best first: at most `most`, each with a score
    /// of at least `least`, and each at least `apart_m` or 0.2 radians from all better ones.
    pub fn search(
        &self,
        surfels: &[Surfel],
        window: &Window,
        least: f64,
        (most, apart_m): (usize, f64),
    ) -> Vec<Candidate> {
        let turns = libm::ceil(window.half_rad / window.step_rad.max(1e-4)) as i32;
        let half = libm::ceil(window.half_m / self.side_m) as i32;
        let turned: Vec<(UnitComplex<f64>, Shape)> = (-turns..=turns)
            .map(|turn| {
                let turn = UnitComplex::new(f64::from(turn) * window.step_rad);
                let rotation = window.middle.rotation * turn;
                let place = |surfel: &Surfel| {
                    cell(rotation * surfel.at + window.middle.translation.vector, self.side_m)
                };
                (rotation, Shape::of(surfels.iter().map(place).collect()))
            })
            .collect();
        let mut open = BinaryHeap::new();
        let block = 1 << (LEVELS - 1);
        for (turn, (_, shape)) in turned.iter().enumerate() {
            for y in (-half..=half).step_by(block) {
                for x in (-half..=half).step_by(block) {
                    open.extend(self.node(shape, (turn, x, y, LEVELS - 1), least));
                }
            }
        }
        let mut found: Vec<Candidate> = Vec::new();
        while let Some(Node { score, turn, x, y, level, .. }) = open.pop() {
            let (rotation, shape) = &turned[turn];
            if level > 0 {
                let half_block = 1 << (level - 1);
                for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                    let (x, y) = (x + dx * half_block, y + dy * half_block);
                    if x <= half && y <= half {
                        open.extend(self.node(shape, (turn, x, y, level - 1), least));
                    }
                }
                continue;
            }
            let moved = Vector2::new(f64::from(x), f64::from(y)) * self.side_m;
            let at = window.middle.translation.vector + moved;
            let motion = Motion::from_parts(at.into(), *rotation);
            let is_apart = |other: &Candidate| {
                (other.motion.translation.vector - at).norm() >= apart_m
                    || (other.motion.rotation / rotation).angle().abs() >= APART_RAD
            };
            if found.iter().all(is_apart) {
                let score = f64::from(score) / f64::from(shape.count().max(1));
                found.push(Candidate { motion, score });
                if found.len() >= most {
                    break;
                }
            }
        }
        found
    }

    /// The block of translations from `x`, `y` at a turn and a level; `None` if no score in it can be
    /// as high as `least`.
    fn node(
        &self,
        shape: &Shape,
        (turn, x, y, level): (usize, i32, i32, usize),
        least: f64,
    ) -> Option<Node> {
        let score = self.planes[level].agreement(shape, (x, y));
        if score == 0 || f64::from(score) < least * f64::from(shape.count()) {
            return None;
        }
        // Shapes of different turns have different numbers of cells, so that shares are compared.
        let share = (u64::from(score) << 32) / u64::from(shape.count().max(1));
        Some(Node { share, score, turn, x, y, level })
    }
}

/// A block of translations at one turn. The greatest has the highest bound; among equals, the finest.
struct Node {
    share: u64,
    score: u32,
    turn: usize,
    x: i32,
    y: i32,
    level: usize,
}

impl Node {
    fn key(&self) -> (u64, Reverse<usize>, usize, i32, i32) {
        (self.share, Reverse(self.level), self.turn, self.x, self.y)
    }
}

impl Ord for Node {
    fn cmp(&self, other: &Self) -> Ordering {
        self.key().cmp(&other.key())
    }
}

impl PartialOrd for Node {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Node {
    fn eq(&self, other: &Self) -> bool {
        self.key() == other.key()
    }
}

impl Eq for Node {}

/// The cell that contains a point.
pub(super) fn cell(at: Vector2<f64>, side_m: f64) -> (i32, i32) {
    let cell = |metres: f64| libm::floor(metres / side_m) as i32;
    (cell(at.x), cell(at.y))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn surfels(points: &[(f64, f64)]) -> Vec<Surfel> {
        points.iter().map(|&(x, y)| Surfel { at: Vector2::new(x, y), normal: None }).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]

        /// Against all motions of the window, each scored point by point.
        #[test]
        fn the_best_motion_is_found(
            reference in proptest::collection::vec((-2.0..2.0f64, -2.0..2.0f64), 1..60),
            points in proptest::collection::vec((-1.5..1.5f64, -1.5..1.5f64), 1..40),
            middle in (-0.5..0.5f64, -0.5..0.5f64, -3.0..3.0f64),
        ) {
            let (reference, points) = (surfels(&reference), surfels(&points));
            let window = Window {
                middle: Motion::new(Vector2::new(middle.0, middle.1), middle.2),
                half_m: 0.65,
                half_rad: 0.1,
                step_rad: 0.05,
            };
            let found = Pyramid::of(&reference, 0.05).search(&points, &window, 0.0, (1, 0.0));
            let cells: Vec<_> = reference.iter().map(|it| cell(it.at, 0.05)).collect();
            let mut best = 0.0f64;
            for turn in -2..=2 {
                let rotation = window.middle.rotation * UnitComplex::new(f64::from(turn) * 0.05);
                let place =
                    |it: &Surfel| cell(rotation * it.at + window.middle.translation.vector, 0.05);
                let mut turned: Vec<_> = points.iter().map(place).collect();
                turned.sort_unstable();
                turned.dedup();
                for (dx, dy) in (-13..=13).flat_map(|x| (-13..=13).map(move |y| (x, y))) {
                    let meets = |&(x, y): &(i32, i32)| {
                        let near = |it: &(i32, i32)| {
                            (it.0 - x - dx).abs() <= 1 && (it.1 - y - dy).abs() <= 1
                        };
                        cells.iter().any(near)
                    };
                    let count = turned.iter().filter(|it| meets(it)).count();
                    best = best.max(count as f64 / turned.len() as f64);
                }
            }
            prop_assert!((found.first().map_or(0.0, |it| it.score) - best).abs() < 1e-9);
        }
    }
}
