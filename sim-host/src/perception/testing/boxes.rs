//! A room with boxes on a floor, rendered for a depth camera: a small simulator for the tests and
//! the benchmark of this folder.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::{DepthImage, DepthNoise, Intrinsics, Lens};

/// An upright box: the bottom south-west corner and the top north-east corner, in metres.
pub(crate) type Cuboid = [[f64; 3]; 2];

/// A camera at a position that looks at another position.
pub(crate) fn lens(width: u32, height: u32, at: [f64; 3], looks_at: [f64; 3]) -> Lens {
    let (at, to) = (Vector3::from(at), Vector3::from(looks_at));
    let forward = (to - at).normalize();
    // Looking straight down, "right" is undefined: use the map's x.
    let right = forward.cross(&Vector3::z()).try_normalize(1e-9).unwrap_or_else(Vector3::x);
    let axes = Matrix3::from_columns(&[right, forward.cross(&right), forward]);
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let intrinsics = Intrinsics::pinhole(width, height, 1.4);
    Lens::new(intrinsics, Isometry3::from_parts(Translation3::from(at), turn)).unwrap()
}

/// The depth image of boxes on a floor at a height, in millimetres.
pub(crate) fn render(lens: &Lens, floor_m: f64, boxes: &[Cuboid]) -> DepthImage {
    let eye = lens.centre().coords;
    DepthImage::from_fn(lens.intrinsics().width, lens.intrinsics().height, |column, row| {
        let way = lens.direction([f64::from(column), f64::from(row)]);
        let floor = (floor_m - eye.z) / way.z;
        let mut nearest = if floor > 0.0 { floor } else { f64::INFINITY };
        for [low, high] in boxes {
            let (mut enters, mut leaves) = (0.0_f64, f64::INFINITY);
            for axis in 0..3 {
                let (a, b) = (low[axis] - eye[axis], high[axis] - eye[axis]);
                let (a, b) = (a / way[axis], b / way[axis]);
                enters = enters.max(a.min(b));
                leaves = leaves.min(a.max(b));
            }
            if enters < leaves && enters > 0.0 {
                nearest = nearest.min(enters);
            }
        }
        // The cast saturates; rays that hit nothing give zero.
        let depth = (nearest * 1000.0).round();
        image::Luma([if depth < 20_000.0 { depth as u16 } else { 0 }])
    })
}

/// Adds noise and dropouts, drawn from a seed: `good` of 1,000 pixels have a measurement.
pub(crate) fn noisy(image: &DepthImage, noise: &DepthNoise, seed: u64, good: u64) -> DepthImage {
    let mut state = seed.wrapping_mul(2).wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    let mut dice = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state >> 11
    };
    let mut noisy = image.clone();
    for depth in noisy.iter_mut().filter(|depth| **depth > 0) {
        let sigma = 1000.0 * noise.sigma_m(f64::from(*depth) / 1000.0);
        // The sum of twelve uniform numbers approximates a normal distribution of standard deviation 1.
        let bell = (0..12).map(|_| (dice() % 1_000) as f64 / 1_000.0).sum::<f64>() - 6.0;
        let measures = dice() % 1_000 < good;
        *depth = if measures { (f64::from(*depth) + sigma * bell).round() as u16 } else { 0 };
    }
    noisy
}
