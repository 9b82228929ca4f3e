//! What a robot has seen on its way through blind ground.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Vector2;
use ubimap_protocol::{
    tile::TileId,
    units::{Millimetres, Pose},
};

use super::geometry::{cell_at, line, position, quarter, rotated};

/// Points of neighbouring columns that are farther apart, in millimetres, are of two surfaces.
const GAP_MM: f64 = 200.0;
/// So many cells of each quarter are remembered: about 400 kB, and 200 m of walls.
const MOST_CELLS: usize = 4_096;

/// Sums over all that has been seen of a surface in a cell.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    middle: Vector2<f64>,
    /// Towards who saw it.
    normal: Vector2<f64>,
    count: u32,
}

/// The surfaces that a robot has seen on its way, as seen from where the server found it to be:
/// finer than the cells that it draws, and not where it believed to be.
#[derive(Clone, Debug, Default)]
pub struct Trail {
    /// By the quarter into which one looked, and by cell.
    seen: [BTreeMap<(i32, i32), Seen>; 4],
    tiles: BTreeSet<TileId>,
}

impl Trail {
    /// Adds the points (as of [`points`](super::points)) that were seen from a pose. Three
    /// neighbours on a line are a surface. If there is too much all that was seen before is
    /// forgotten.
    pub fn add(&mut self, pose: Pose, points: &[[f64; 2]], resolution: Millimetres) {
        if self.seen.iter().any(|seen| seen.len() > MOST_CELLS) {
            *self = Self::default();
        }
        let arms = points.iter().map(|&[x, y]| rotated(Vector2::new(x, y), pose.heading.radians()));
        let arms: Vec<Vector2<f64>> = arms.collect();
        for three in arms.windows(3) {
            if three.windows(2).any(|two| (two[1] - two[0]).norm() > GAP_MM) {
                continue;
            }
            let Some((arm, normal)) = line(three) else { continue };
            let middle = position(pose) + arm;
            let (x, y) = cell_at(middle, f64::from(resolution.0));
            self.tiles.extend(TileId::of_cell(x, y));
            let seen = self.seen[quarter(arm)].entry((x, y)).or_default();
            seen.middle += middle;
            seen.normal += if normal.dot(&arm) < 0.0 { normal } else { -normal };
            seen.count += 1;
        }
    }

    /// Whether anything has been seen in a tile.
    pub fn has(&self, id: TileId) -> bool {
        self.tiles.contains(&id)
    }

    /// The cells in which surfaces have been seen by looking into a quarter; of each the middle of
    /// what was seen, and the direction across.
    pub(super) fn seen(
        &self,
        quarter: usize,
    ) -> impl Iterator<Item = ((i32, i32), Vector2<f64>, Vector2<f64>)> {
        self.seen[quarter].iter().filter_map(|(&cell, seen)| {
            let normal = seen.normal.try_normalize(f64::EPSILON)?;
            Some((cell, seen.middle / f64::from(seen.count), normal))
        })
    }
}
