//! The surfaces that a robot has seen on its way through blind ground.

use std::collections::BTreeMap;

use nalgebra::Vector2;
use ubimap_protocol::units::{Millimetres, Pose};

use super::geometry::{cell_at, line, position, quarter, rotated};

/// Neighbouring points farther apart than this, in millimetres, belong to two surfaces.
const GAP_MM: f64 = 200.0;
/// Maximum number of cells remembered per quadrant: about 400 kB in total, for 200 m of walls.
const MAX_CELLS: usize = 4_096;

/// Sums over all observations of a surface in a cell.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    middle: Vector2<f64>,
    /// Sum of the normals, which point towards the observer.
    normal: Vector2<f64>,
    count: u32,
}

/// The surfaces that a robot has seen on its way, placed by its poses as the server follows them, in a frame of their own.
/// They are finer than the cells that the robot draws, and do not include its pose error.
#[derive(Clone, Debug, Default)]
pub struct Trail {
    /// The surfaces, by viewing quadrant and cell.
    seen: [BTreeMap<(i32, i32), Seen>; 4],
}

impl Trail {
    /// Adds the points (from [`points`](super::points)) seen from a pose; three neighbours on a
    /// line form a surface. If any quadrant already has more than the maximum number of cells, the
    /// trail is cleared first.
    pub fn add(&mut self, pose: Pose, points: &[[f64; 2]], resolution: Millimetres) {
        if self.seen.iter().any(|seen| seen.len() > MAX_CELLS) {
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
            let seen = self.seen[quarter(arm)].entry((x, y)).or_default();
            seen.middle += middle;
            seen.normal += if normal.dot(&arm) < 0.0 { normal } else { -normal };
            seen.count += 1;
        }
    }

    /// The cells with surfaces visible when looking into a quadrant, each with the surfaces' mean
    /// point and normal.
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
