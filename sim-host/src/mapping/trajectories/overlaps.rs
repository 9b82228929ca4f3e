//! Which pieces saw the same ground.

use core::cmp::Reverse;
use std::collections::{BTreeMap, HashMap};

use nalgebra::Point2;

use crate::mapping::submaps::{Cloud, Motion};

/// Side of the squares in which surfaces are noted, in metres.
const SIDE_M: f64 = 0.4;

type Square = (i32, i32);

/// The squares with surfaces of each piece.
#[derive(Debug, Default)]
pub(super) struct Overlaps {
    /// They are looked up, never walked through, so the order of the map does not matter.
    pieces: HashMap<Square, Vec<usize>>,
    placed: BTreeMap<usize, (Motion, Vec<Square>)>,
}

impl Overlaps {
    /// Notes the squares of a piece at a pose, instead of those at an earlier pose.
    pub(super) fn place(&mut self, piece: usize, cloud: &Cloud, pose: &Motion) {
        if let Some((_, squares)) = self.placed.remove(&piece) {
            for square in squares {
                if let Some(pieces) = self.pieces.get_mut(&square) {
                    pieces.retain(|it| *it != piece);
                }
            }
        }
        let cell = |metres: f64| libm::floor(metres / SIDE_M) as i32;
        let mut squares: Vec<Square> = cloud
            .surfels()
            .iter()
            .map(|surfel| pose * Point2::from(surfel.at))
            .map(|at| (cell(at.x), cell(at.y)))
            .collect();
        squares.sort_unstable();
        squares.dedup();
        for square in &squares {
            self.pieces.entry(*square).or_default().push(piece);
        }
        self.placed.insert(piece, (*pose, squares));
    }

    /// Where a piece was placed.
    pub(super) fn placed(&self, piece: usize) -> Option<&Motion> {
        self.placed.get(&piece).map(|(pose, _)| pose)
    }

    /// The other pieces in a piece's squares and the number of squares that they share, most first.
    pub(super) fn of(&self, piece: usize) -> impl Iterator<Item = (usize, usize)> + use<> {
        let mut shared: BTreeMap<usize, usize> = BTreeMap::new();
        for square in self.placed.get(&piece).into_iter().flat_map(|(_, squares)| squares) {
            for &other in self.pieces.get(square).into_iter().flatten().filter(|it| **it != piece) {
                *shared.entry(other).or_default() += 1;
            }
        }
        let mut shared: Vec<(usize, usize)> = shared.into_iter().collect();
        shared.sort_by_key(|&(other, count)| (Reverse(count), other));
        shared.into_iter()
    }
}
