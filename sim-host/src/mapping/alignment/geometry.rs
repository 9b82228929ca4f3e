//! Points, lines and cells of the plane, in millimetres; lines in any unit.

use core::f64::consts::FRAC_PI_2;

use libm::{atan2, cos, sin};
use nalgebra::Vector2;
use ubimap_protocol::units::Pose;

/// Maximum variance of the points across a line, as a fraction of their variance along it.
const LINE_WIDTH: f64 = 0.1;

/// The quadrant of a viewing direction: bit 0 for east, bit 1 for north.
pub(super) fn quarter(arm: Vector2<f64>) -> usize {
    usize::from(arm.x > 0.0) | usize::from(arm.y > 0.0) << 1
}

/// Fits a line to the points. Returns their mean and the line's unit normal, or `None` if they do
/// not form a line.
pub(in crate::mapping) fn line(points: &[Vector2<f64>]) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let mean = points.iter().sum::<Vector2<f64>>() / points.len() as f64;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for point in points {
        let off = point - mean;
        xx += off.x * off.x;
        xy += off.x * off.y;
        yy += off.y * off.y;
    }
    let spread = ((xx - yy) * (xx - yy) + 4.0 * xy * xy).sqrt();
    if xx + yy - spread > LINE_WIDTH * (xx + yy + spread) {
        return None;
    }
    let across = 0.5 * atan2(2.0 * xy, xx - yy) + FRAC_PI_2;
    Some((mean, Vector2::new(cos(across), sin(across))))
}

/// The cell that contains a point.
pub(super) fn cell_at(point: Vector2<f64>, resolution: f64) -> (i32, i32) {
    let cell = |millimetres: f64| libm::floor(millimetres / resolution) as i32;
    (cell(point.x), cell(point.y))
}

/// The position of a pose in millimetres.
pub(super) fn position(pose: Pose) -> Vector2<f64> {
    Vector2::new(f64::from(pose.x.0), f64::from(pose.y.0))
}

/// All cell offsets of at most `reach` along x and along y.
pub(super) fn square(reach: i32) -> impl Iterator<Item = (i32, i32)> + Clone {
    (-reach..=reach).flat_map(move |dy| (-reach..=reach).map(move |dx| (dx, dy)))
}

pub(super) fn rotated(point: Vector2<f64>, angle: f64) -> Vector2<f64> {
    let (sin, cos) = (sin(angle), cos(angle));
    Vector2::new(cos * point.x - sin * point.y, sin * point.x + cos * point.y)
}
