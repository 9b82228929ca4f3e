//! The noise of depths in whole millimetres, for the loops over pixels.

use crate::camera::DepthNoise;

/// Fraction bits of the coefficients.
const SHIFT: u32 = 32;

/// [`DepthNoise`] in integers.
#[derive(Clone, Copy, Debug)]
pub(super) struct DepthSigma {
    /// The constant term, in 2^-32 mm.
    constant: i64,
    /// The quadratic term, in 2^-32 per mm.
    quadratic: i64,
}

impl DepthSigma {
    pub(super) fn of(noise: &DepthNoise) -> Self {
        let fixed = |value: f64| (value * (1_i64 << SHIFT) as f64).round() as i64;
        Self {
            constant: fixed(noise.constant_m() * 1000.0),
            quadratic: fixed(noise.quadratic_per_m() / 1000.0),
        }
    }

    /// The standard deviation at a depth, both in millimetres, rounded: 1 to 65,535.
    #[inline]
    pub(super) fn mm(self, depth: u16) -> i64 {
        let depth = i64::from(depth);
        let sigma = self.constant + depth * depth * self.quadratic;
        ((sigma + (1 << (SHIFT - 1))) >> SHIFT).clamp(1, i64::from(u16::MAX))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers_follow_the_model_and_never_overflow() {
        let noises = [(0.001, 0.00475), (0.02, 0.0), (1.0, 100.0), (0.0, 0.0)];
        for noise in noises.map(|(constant, quadratic)| DepthNoise::new(constant, quadratic)) {
            let noise = noise.unwrap();
            let sigma = DepthSigma::of(&noise);
            for depth in (0..=u16::MAX).step_by(37).chain([u16::MAX]) {
                let exact_mm = noise.sigma_m(f64::from(depth) / 1000.0) * 1000.0;
                let expected = exact_mm.clamp(1.0, 65_535.0);
                // With 32 fraction bits per coefficient, the total error is below half a millimetre
                // up to 65 m.
                assert!((sigma.mm(depth) as f64 - expected).abs() < 1.01, "{noise:?} at {depth}");
            }
        }
    }
}
