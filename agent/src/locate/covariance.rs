//! The covariance of a pose.

use nalgebra::{Vector2, Vector3};

/// Upper bound of the rounding error of a variance in one step, relative to its operands. It is
/// added back in each step, so that the matrix stays positive.
const ROUNDING: f32 = 1.0e-6;

/// A symmetric 3 x 3 matrix over x, y (mm) and heading (rad), all in `map`, stored as six numbers:
/// takes a tenth of the instructions of a general matrix.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Covariance {
    pub(super) xx: f32,
    pub(super) xy: f32,
    pub(super) yy: f32,
    pub(super) xh: f32,
    pub(super) yh: f32,
    pub(super) hh: f32,
}

impl Covariance {
    /// A diagonal matrix of variances.
    pub(super) fn diagonal(variances: Vector3<f32>) -> Self {
        Self { xx: variances.x, xy: 0.0, yy: variances.y, xh: 0.0, yh: 0.0, hh: variances.z }
    }

    /// Propagates the covariance by a known step of the robot: F P F', where F is the identity
    /// except for the effect of the heading on the position.
    pub(super) fn carry(&mut self, step: Vector2<f32>) {
        let (dx, dy) = (step.x, step.y);
        let (turned_x, turned_y) = (dy * dy * self.hh, dx * dx * self.hh);
        self.xy += dx * self.xh - dy * self.yh - dx * dy * self.hh;
        self.xx += turned_x - 2.0 * dy * self.xh + ROUNDING * (self.xx + turned_x);
        self.yy += turned_y + 2.0 * dx * self.yh + ROUNDING * (self.yy + turned_y);
        self.xh -= dy * self.hh;
        self.yh += dx * self.hh;
        self.hh += ROUNDING * self.hh;
    }

    /// Adds independent noise with these variances; `position` applies to x and to y.
    pub(super) fn grow(&mut self, position: f32, heading: f32) {
        self.xx += position;
        self.yy += position;
        self.hh += heading;
    }

    pub(super) fn column(&self, axis: Axis) -> Vector3<f32> {
        match axis {
            Axis::X => Vector3::new(self.xx, self.xy, self.xh),
            Axis::Y => Vector3::new(self.xy, self.yy, self.yh),
            Axis::Heading => Vector3::new(self.xh, self.yh, self.hh),
        }
    }

    /// Updates the covariance for a measurement of one of the three states: P - c c' `scale`, where
    /// `column` c is that state's column of P, and `scale` the inverse of the innovation's
    /// variance.
    pub(super) fn reduce(&mut self, column: Vector3<f32>, scale: f32) {
        let scaled = column * scale;
        self.xx += ROUNDING * self.xx - scaled.x * column.x;
        self.xy -= scaled.x * column.y;
        self.yy += ROUNDING * self.yy - scaled.y * column.y;
        self.xh -= scaled.x * column.z;
        self.yh -= scaled.y * column.z;
        self.hh += ROUNDING * self.hh - scaled.z * column.z;
    }
}

/// One of the three states.
#[derive(Clone, Copy, Debug)]
pub(super) enum Axis {
    X,
    Y,
    Heading,
}

impl Axis {
    /// This state's component of a vector.
    pub(super) fn of(self, vector: Vector3<f32>) -> f32 {
        match self {
            Self::X => vector.x,
            Self::Y => vector.y,
            Self::Heading => vector.z,
        }
    }
}
