//! A piece of a trajectory.

use core::ops::Range;
use std::collections::BTreeMap;

use nalgebra::{Matrix3, Point2};
use ubimap_protocol::{
    tile::TileId,
    time::Instant,
    units::{Millimetres, RobotId},
};

use super::compass::{Direction, directions};
use crate::mapping::{
    Mask,
    submaps::{Cloud, Motion, View, is_within},
};

/// A robot's reported pose that differs by less than this from the expected one was not corrected: in metres and
/// radians.
const SAME: (f64, f64) = (0.01, 0.005);

/// A view of a piece.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placed {
    pub(super) time: Instant,
    /// The robot's pose in the piece's frame.
    pub(super) at: Motion,
    /// The pose that the robot believed in.
    pub(super) reported: Motion,
    /// Whether cameras saw the robot: then it knew its pose.
    pub(super) is_seen: bool,
}

/// A short piece of a trajectory. Its frame is the pose of its first view.
#[derive(Debug)]
pub(super) struct Piece {
    pub(super) robot: RobotId,
    /// In order of time; never empty.
    pub(super) views: Vec<Placed>,
    /// What was seen.
    pub(super) cloud: Cloud,
    /// The directions of the surfaces.
    pub(super) directions: Vec<Direction>,
    /// The heading in the map that it has by these, and its deviation, in radians.
    pub(super) heading: Option<(f64, f64)>,
    /// Where the ground is free: triangles.
    free: Vec<[Point2<f64>; 3]>,
    /// That ground in the map.
    pub(super) ground: BTreeMap<TileId, Mask>,
    /// Covariance of the step to it: of x, y and turn in the frame of the piece before; with some caution. That of its
    /// pose in the map, if it is the robot's first.
    pub(super) step: Matrix3<f64>,
    /// Covariance of its pose in the map, if something else than steps has held it there.
    pub(super) held: Option<Matrix3<f64>>,
    /// Where a match with the whole map puts it, which may be wrong.
    pub(super) suggested: Option<Motion>,
    /// Whether cameras saw the robot meanwhile.
    pub(super) is_seen: bool,
    /// Whether the next view can't belong to it.
    pub(super) is_closed: bool,
    /// Whether the map has it.
    pub(super) is_in_map: bool,
    /// Whether `ground` is where the piece is.
    pub(super) is_put: bool,
}

impl Piece {
    /// A robot's piece with its first view; `is_seen` says whether cameras saw the robot.
    pub(super) fn new(robot: RobotId, view: &View, step: Matrix3<f64>, is_seen: bool) -> Self {
        let mut piece = Self {
            robot,
            views: Vec::new(),
            cloud: Cloud::default(),
            directions: Vec::new(),
            heading: None,
            free: Vec::new(),
            ground: BTreeMap::new(),
            step,
            held: None,
            suggested: None,
            is_seen,
            is_closed: false,
            is_in_map: false,
            is_put: true,
        };
        piece.add(view, Motion::identity(), is_seen);
        piece
    }

    /// Adds a view from a pose in the piece's frame.
    pub(super) fn add(&mut self, view: &View, at: Motion, is_seen: bool) {
        self.cloud.extend(view.surfels.iter().map(|surfel| surfel.moved(&at)));
        let turn = at.rotation.angle();
        let turned = |it: Direction| Direction { angle: it.angle + turn, ..it };
        self.directions.extend(directions(&view.surfels).map(turned));
        self.free.extend(view.free.iter().map(|&[right, left]| {
            [Point2::origin(), right.into(), left.into()].map(|corner: Point2<f64>| at * corner)
        }));
        self.views.push(Placed { time: view.time, at, reported: view.reported, is_seen });
    }

    /// The robot has hardly moved since its last view, but may have corrected its pose. Returns whether this is its last
    /// view now.
    pub(super) fn stand(&mut self, view: &View, at: Motion, is_seen: bool) -> bool {
        let last = self.last();
        let expected = last.reported * last.at.inv_mul(&at);
        let differs =
            last.is_seen != is_seen || !is_within(&expected.inv_mul(&view.reported), SAME);
        if differs {
            self.views.push(Placed { time: view.time, at, reported: view.reported, is_seen });
        }
        differs
    }

    /// Forgets what ground is free, and in which directions surfaces are.
    pub(super) fn void_ground(&mut self) {
        self.directions.clear();
        self.free.clear();
        self.ground.clear();
    }

    /// Takes over where the piece is in the map, if that is not done yet.
    pub(super) fn put(&mut self, pose: &Motion, resolution: Millimetres) {
        if core::mem::replace(&mut self.is_put, true) {
            return;
        }
        self.ground.clear();
        for triangle in &self.free {
            let corners = triangle.map(|it| (pose * it) / resolution.metres());
            fill(&corners, |y, cells| {
                for x in cells {
                    let Some(id) = TileId::of_cell(x, y) else { continue };
                    let (west, south) = id.first_cell();
                    self.ground.entry(id).or_default()[(y - south) as usize] |= 1 << (x - west);
                }
            });
        }
    }

    /// The newest view.
    pub(super) fn last(&self) -> &Placed {
        &self.views[self.views.len() - 1]
    }
}

/// Calls `row` with each row of cells in a triangle, and its cells: those with their middles in it. Triangles side by
/// side leave no gaps.
fn fill(corners: &[Point2<f64>; 3], mut row: impl FnMut(i32, Range<i32>)) {
    let middles = |from: f64, to: f64| libm::ceil(from - 0.5) as i32..libm::ceil(to - 0.5) as i32;
    let [low, high] = [f64::min, f64::max].map(|it| corners.iter().map(|at| at.y).reduce(it));
    for y in middles(low.unwrap_or(0.0), high.unwrap_or(0.0)) {
        let at = f64::from(y) + 0.5;
        let crossings = (0..3).filter_map(|side| {
            let (from, to) = (corners[side], corners[(side + 1) % 3]);
            ((from.y <= at) != (to.y <= at))
                .then(|| from.x + (to.x - from.x) * (at - from.y) / (to.y - from.y))
        });
        let (west, east) = crossings
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(west, east), x| (west.min(x), east.max(x)));
        row(y, middles(west, east));
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use nalgebra::Vector2;
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// Exactly the cells are filled that have their middles in the fan of triangles.
        #[test]
        fn what_was_seen_is_filled(
            apex in (-9.0..9.0f64, -9.0..9.0f64),
            first in 0.0..6.3f64,
            ranges in proptest::collection::vec(0.0..30.0f64, 1..12),
        ) {
            let apex = Point2::new(apex.0, apex.1);
            let end = |bearing: f64, range: f64| apex + Vector2::new(bearing.cos(), bearing.sin()) * range;
            let fan: Vec<[Point2<f64>; 3]> = (0..).zip(&ranges).map(|(column, &range)| {
                let bearing = first + 0.1 * f64::from(column);
                [apex, end(bearing, range), end(bearing + 0.1, range)]
            }).collect();
            let mut filled = BTreeSet::new();
            for triangle in &fan {
                fill(triangle, |y, cells| filled.extend(cells.map(|x| (x, y))));
            }
            let cross = |a: Vector2<f64>, b: Vector2<f64>| a.x * b.y - a.y * b.x;
            for (x, y) in (-40..40).flat_map(|x| (-40..40).map(move |y| (x, y))) {
                let middle = Point2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let sides = |[a, b, c]: &[Point2<f64>; 3]| {
                    [(a, b), (b, c), (c, a)].map(|(from, to)| cross(to - from, middle - from))
                };
                let inside = |least: f64| {
                    fan.iter().any(|triangle| sides(triangle).iter().all(|it| *it > least))
                };
                if inside(1e-9) || !inside(-1e-9) {
                    prop_assert_eq!(filled.contains(&(x, y)), inside(0.0), "{} {}", x, y);
                }
            }
        }
    }
}
