//! The pixels of one sensor: their rays, and which of them may see a prism.

use nalgebra::Point3;
use parry2d_f64::glamx::{DVec2, DVec3, Vec3};

use super::super::shapes::{Prism, Rim};
use crate::camera::Lens;

/// Minimum distance in metres from the sensor's plane of anything that is projected.
const NEAR: f64 = 0.01;

/// A rectangle of pixels; the ends are exclusive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Rectangle {
    pub(super) left: usize,
    pub(super) top: usize,
    pub(super) right: usize,
    pub(super) bottom: usize,
}

impl Rectangle {
    pub(super) fn is_empty(&self) -> bool {
        self.left >= self.right || self.top >= self.bottom
    }

    /// The intersection of two rectangles.
    pub(super) fn within(&self, other: &Self) -> Self {
        Self {
            left: self.left.max(other.left),
            top: self.top.max(other.top),
            right: self.right.min(other.right),
            bottom: self.bottom.min(other.bottom),
        }
    }

    /// The rectangle enlarged by one pixel on each side.
    pub(super) fn grown(&self) -> Self {
        Self {
            left: self.left.saturating_sub(1),
            top: self.top.saturating_sub(1),
            right: self.right + 1,
            bottom: self.bottom + 1,
        }
    }
}

/// A sensor without distortion, with its pose.
pub(super) struct Pinhole {
    lens: Lens,
    pub(super) width: usize,
    pub(super) height: usize,
    /// Optical centre in `map`.
    pub(super) eye: DVec3,
    /// Ray of the first pixel in `map` for one metre of depth, and its change along a row and down a
    /// column.
    first: Vec3,
    across: Vec3,
    down: Vec3,
}

impl Pinhole {
    pub(super) fn new(lens: &Lens) -> Self {
        let direction = |column: f64, row: f64| {
            let way = lens.direction([column, row]);
            DVec3::new(way.x, way.y, way.z)
        };
        let first = direction(0.0, 0.0);
        let centre = lens.centre();
        Self {
            lens: *lens,
            width: lens.intrinsics().width as usize,
            height: lens.intrinsics().height as usize,
            eye: DVec3::new(centre.x, centre.y, centre.z),
            first: first.as_vec3(),
            across: (direction(1.0, 0.0) - first).as_vec3(),
            down: (direction(0.0, 1.0) - first).as_vec3(),
        }
    }

    /// The rectangle of all pixels.
    pub(super) fn whole(&self) -> Rectangle {
        Rectangle { left: 0, top: 0, right: self.width, bottom: self.height }
    }

    /// The ray of a position in the image, for one metre of depth.
    pub(super) fn way(&self, column: f32, row: f32) -> Vec3 {
        self.first + self.step(column, row)
    }

    /// The change of the ray for an offset in the image.
    pub(super) fn step(&self, columns: f32, rows: f32) -> Vec3 {
        self.across * columns + self.down * rows
    }

    /// Horizontal focal length in pixels.
    pub(super) fn focal(&self) -> f64 {
        self.lens.intrinsics().fx
    }

    /// A rectangle that contains all pixels that may see a prism.
    pub(super) fn bounds(&self, prism: &Prism) -> Rectangle {
        let corners = match prism.footprint.rim() {
            Rim::Corners(corners) => corners,
            Rim::Disc { centre, radius } => [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
                .map(|(x, y)| centre + DVec2::new(x, y) * radius)
                .to_vec(),
        };
        let inverse = self.lens.pose().inverse();
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let mut behind = 0;
        for corner in &corners {
            for height in [prism.bottom, prism.top] {
                let point = inverse * Point3::new(corner.x, corner.y, height);
                match self.lens.intrinsics().project(&point.coords) {
                    Some([column, row]) if point.z > NEAR => {
                        let at = DVec2::new(column, row);
                        (low, high) = (low.min(at), high.max(at));
                    }
                    _ => behind += 1,
                }
            }
        }
        if behind == 2 * corners.len() {
            return Rectangle::default();
        }
        if behind > 0 {
            return self.whole();
        }
        let pixel = |at: f64, most: usize| at.clamp(0.0, most as f64) as usize;
        Rectangle {
            left: pixel(low.x.floor(), self.width),
            top: pixel(low.y.floor(), self.height),
            right: pixel(high.x.ceil() + 1.0, self.width),
            bottom: pixel(high.y.ceil() + 1.0, self.height),
        }
    }
}
