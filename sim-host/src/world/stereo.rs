//! Depth from two imagers side by side, row by row.

/// Parts of a pixel in which a D435 gives a disparity: five fractional bits.
pub(super) const PARTS: f32 = 32.0;

/// A difference of disparity between two neighbouring pixels, in pixels, that no surface shows
/// which is not seen edge on: the edge of something.
const EDGE: f32 = 0.5;

/// Added to and taken from a number of less than 2^22, it rounds it to the nearest whole one.
const ROUND: f32 = 12_582_912.0;

/// A number's whole part is in the lower bits of its sum with this.
const WHOLE: f32 = 8_388_608.0;

/// A stereo camera: how depth becomes disparity and, measured, depth again.
///
/// Disparities are in parts of a pixel here. The deviation of a depth `z` is that of a disparity
/// times `z^2 / (focal * baseline)`, as the maker states it (Intel, Best-known-methods for tuning
/// RealSense D400 depth cameras): with a D435's 0.08 px at 337 px and 50 mm, 0.5 % of 1 m and
/// 1.9 % of 4 m.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Stereo {
    /// The disparity of one metre.
    scale: f32,
    /// The least and the greatest depth that it gives, in millimetres.
    range: [f32; 2],
}

impl Stereo {
    /// A camera with this focal length in pixels and baseline in metres, that gives depths from
    /// the one to the other, in metres.
    pub(super) fn new(focal: f64, baseline: f64, range: [f64; 2]) -> Self {
        Self {
            scale: (focal * baseline) as f32 * PARTS,
            // A depth has 16 bits.
            range: range.map(|metres| (metres as f32 * 1000.0).min(65_535.0)),
        }
    }

    /// The true disparities of depths in metres.
    pub(super) fn disparities(&self, depths: &[f32], into: &mut [f32]) {
        for (disparity, depth) in into.iter_mut().zip(depths) {
            *disparity = self.scale / depth;
        }
    }

    /// A row of an image in millimetres, zero where there is no depth: of these disparities below
    /// those, with what the noise adds to them (infinite where there is no match).
    ///
    /// Pixels whose surface the right imager does not see, because something nearer covers it
    /// there, have no depth: a shadow to the left of whatever stands out. Nor has every other
    /// pixel on an edge.
    pub(super) fn measure(
        &self,
        row: &[f32],
        above: &[f32],
        added: &mut [f32],
        image: &mut Vec<u16>,
    ) {
        lose_edges(row, above, added);
        lose_shadows(row, added);
        let [nearest, farthest] = self.range;
        image.extend(row.iter().zip(added).map(|(disparity, added)| {
            let parts = (disparity + *added) + ROUND - ROUND;
            let millimetres = 1000.0 * self.scale / parts;
            if millimetres >= nearest && millimetres <= farthest {
                (millimetres + WHOLE).to_bits() as u16
            } else {
                0
            }
        }));
    }
}

/// On an edge, a match is found where the noise is below its mean only.
fn lose_edges(row: &[f32], above: &[f32], added: &mut [f32]) {
    let edge = EDGE * PARTS;
    let is_lost = |jump: f32, noise: f32| jump.abs() > edge && noise > 0.0;
    for ((here, above), added) in row.iter().zip(above).zip(added.iter_mut()) {
        let lost = is_lost(here - above, *added);
        *added = if lost { f32::INFINITY } else { *added };
    }
    for (pair, added) in row.windows(2).zip(added) {
        let lost = is_lost(pair[1] - pair[0], *added);
        *added = if lost { f32::INFINITY } else { *added };
    }
}

/// A pixel is seen by the right imager so many columns farther left as its disparity says; there
/// something to its right may come before it.
fn lose_shadows(row: &[f32], added: &mut [f32]) {
    let mut nearest = f32::INFINITY;
    for (column, (disparity, added)) in row.iter().zip(added).enumerate().rev() {
        let there = column as f32 * PARTS - disparity;
        if there > nearest {
            *added = f32::INFINITY;
        }
        nearest = nearest.min(there);
    }
}
