//! Points on surfaces, with the surfaces' normals, found by their positions.

use std::collections::HashMap;

use nalgebra::{Point2, Vector2};

use super::rigid::Motion;

/// Side of the squares in which points are looked up, in metres: the greatest distance at which a
/// point is matched.
pub(super) const SQUARE_M: f64 = 0.25;
/// Greatest distance between neighbouring points of one surface: in metres, and as a share of their
/// distance from the sensor. Columns of 2.8 degrees on a wall seen at 20 degrees are 0.15 of it apart.
const APART: (f64, f64) = (0.1, 0.15);

/// A point on a surface, in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surfel {
    /// The point.
    pub at: Vector2<f64>,
    /// The surface's unit normal, towards the side from which it was seen; `None` for a point
    /// without neighbours, such as a post.
    pub normal: Option<Vector2<f64>>,
}

impl Surfel {
    /// The surfel in the frame from which `motion` starts.
    pub fn moved(&self, motion: &Motion) -> Self {
        let at = (motion * Point2::from(self.at)).coords;
        Self { at, normal: self.normal.map(|normal| motion.rotation * normal) }
    }
}

/// The surfels of a scan, from its points in order of bearing, in the sensor's frame.
pub(super) fn surfels(points: &[Vector2<f64>]) -> Vec<Surfel> {
    let surfel = |(index, &at): (usize, &Vector2<f64>)| {
        let reach = APART.0 + APART.1 * at.norm();
        let beside = |other: Option<&Vector2<f64>>| {
            other.copied().filter(|other| (other - at).norm() <= reach)
        };
        let before = beside(index.checked_sub(1).and_then(|index| points.get(index)));
        let after = beside(points.get(index + 1));
        let along = after.unwrap_or(at) - before.unwrap_or(at);
        let normal = (along.norm() > 1e-3).then(|| {
            let normal = Vector2::new(-along.y, along.x) / along.norm();
            if normal.dot(&at) > 0.0 { -normal } else { normal }
        });
        Surfel { at, normal }
    };
    points.iter().enumerate().map(surfel).collect()
}

/// A set of surfels.
#[derive(Clone, Debug, Default)]
pub struct Cloud {
    surfels: Vec<Surfel>,
    /// The indices of the surfels in each square. They are looked up, never walked through, so the
    /// order of the map does not matter.
    squares: HashMap<(i32, i32), Vec<u32>>,
}

impl Cloud {
    /// Adds surfels.
    pub fn extend(&mut self, surfels: impl IntoIterator<Item = Surfel>) {
        for surfel in surfels {
            let index = self.surfels.len() as u32;
            self.surfels.push(surfel);
            self.squares.entry(square(surfel.at)).or_default().push(index);
        }
    }

    /// The surfels in the order in which they were added.
    pub fn surfels(&self) -> &[Surfel] {
        &self.surfels
    }

    /// Whether there are surfels about a surfel.
    pub fn is_beside(&self, surfel: &Surfel) -> bool {
        self.around(surfel.at).next().is_some()
    }

    /// The surfels in the nine squares around a point, with their places in the order: all within [`SQUARE_M`], and some
    /// beyond.
    pub(super) fn around(&self, at: Vector2<f64>) -> impl Iterator<Item = (usize, &Surfel)> {
        let (x, y) = square(at);
        let squares = (-1..=1).flat_map(move |dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
        squares
            .filter_map(|square| self.squares.get(&square))
            .flatten()
            .filter_map(|&index| Some((index as usize, self.surfels.get(index as usize)?)))
    }
}

fn square(at: Vector2<f64>) -> (i32, i32) {
    let cell = |metres: f64| libm::floor(metres / SQUARE_M) as i32;
    (cell(at.x), cell(at.y))
}
