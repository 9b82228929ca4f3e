//! Finds the floor in depth images, to check the up axis that the user has stated.

use std::path::PathBuf;

use nalgebra::Vector3;

use crate::recording::{
    camera_pose::CameraPose, depth_image::depths_mm, error::LogError, intrinsics::IntrinsicsFile,
};

/// Maximum number of frames that are evaluated.
const FRAMES: usize = 8;
/// Number of samples across an image.
const SAMPLES: u32 = 80;
/// Minimum cosine of the angle between a surface's normal and the image's up axis (65 degrees).
/// Other surfaces are walls.
const MIN_UP_COS: f64 = 0.42;
/// Minimum cosine of the angle between normals of the same plane (6 degrees), which allows for the
/// noise of the depths.
const SAME_COS: f64 = 0.9945;
/// Minimum number of samples on the floor, and minimum fraction of all samples that must be on the
/// floor.
const MIN_SAMPLES: usize = 100;
const MIN_SHARE: f64 = 0.05;
/// Maximum number of normals that are tried as candidates for the floor's normal.
const TRIED: usize = 200;

/// The normal of the floor in the world: the most frequent direction among surfaces that face up.
/// `None` if too few surfaces share a direction. Reads up to eight images.
pub(super) fn normal(
    images: &[PathBuf],
    poses: &[CameraPose],
    intrinsics: &IntrinsicsFile,
) -> Result<Option<Vector3<f64>>, LogError> {
    let (mut facing_up, mut sampled) = (Vec::new(), 0);
    let stride = images.len().div_ceil(FRAMES).max(1);
    for (image, pose) in images.iter().zip(poses).step_by(stride) {
        let depths = depths_mm(image, intrinsics)?;
        let image_up = pose.rotation.column(1) * -intrinsics.fy.signum();
        let normals = normals(&depths, intrinsics, pose);
        sampled += normals.len();
        facing_up.extend(normals.into_iter().filter(|normal| normal.dot(&image_up) > MIN_UP_COS));
    }
    let near = |axis: &Vector3<f64>| {
        let axis = *axis;
        facing_up.iter().filter(move |normal| normal.dot(&axis) > SAME_COS)
    };
    let stride = facing_up.len().div_ceil(TRIED).max(1);
    let best = facing_up.iter().step_by(stride).max_by_key(|axis| near(axis).count());
    let Some(mut axis) = best.copied() else { return Ok(None) };
    for _ in 0..3 {
        axis = near(&axis).sum::<Vector3<f64>>().try_normalize(1e-6).unwrap_or(axis);
    }
    let found = near(&axis).count();
    let is_enough = found >= MIN_SAMPLES && found as f64 >= MIN_SHARE * sampled as f64;
    Ok(is_enough.then_some(axis))
}

/// The normals of the surfaces in an image, in world coordinates, pointing towards the camera.
fn normals(depths: &[u16], intrinsics: &IntrinsicsFile, pose: &CameraPose) -> Vec<Vector3<f64>> {
    let IntrinsicsFile { width, height, fx, fy, cx, cy, .. } = *intrinsics;
    let step = (width / SAMPLES).max(1);
    let point = |column: u32, row: u32| {
        let depth = *depths.get(row as usize * width as usize + column as usize)?;
        let z = f64::from(depth) / 1e3;
        let along = |pixel: u32, centre: f64, focal: f64| (f64::from(pixel) - centre) / focal * z;
        let at = Vector3::new(along(column, cx, fx), along(row, cy, fy), z);
        (depth > 0).then(|| pose.rotation * at)
    };
    let normal = |column: u32, row: u32| {
        let at = point(column, row)?;
        let [right, below] = [point(column + step, row)?, point(column, row + step)?];
        // Neighbouring samples with a jump in distance do not belong to the same surface.
        let is_edge = |other: &Vector3<f64>| (other.norm() - at.norm()).abs() > 0.1 * at.norm();
        if is_edge(&right) || is_edge(&below) {
            return None;
        }
        let normal = (right - at).cross(&(below - at)).try_normalize(1e-9)?;
        Some(if normal.dot(&at) < 0.0 { normal } else { -normal })
    };
    let rows = (0..height.saturating_sub(step)).step_by(step as usize);
    rows.flat_map(|row| {
        let columns = (0..width.saturating_sub(step)).step_by(step as usize);
        columns.filter_map(move |column| normal(column, row))
    })
    .collect()
}
