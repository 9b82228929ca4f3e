//! Which labelled pairs of landmarks agree on one transform: wrong labels are left out before the
//! closed form (random sample consensus).

use nalgebra::Isometry3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    pairing::{PairFault, PairwiseOptions},
    tie::{Tie, weighted},
};

/// Maximum number of samples; below it, all triples are tried. With 40 % wrong labels 500 samples
/// have 100 without a wrong one.
const SAMPLES: usize = 500;
/// The probability with which the samples may miss a set without wrong labels.
const MISSED: f64 = 1e-9;
/// Factors of the gate: a noise that was stated too small is noticed by the residuals.
const WIDER: [f64; 3] = [1.0, 2.0, 4.0];
/// Number of agreeing pairs from which their own scatter shrinks the gate.
const ENOUGH_FOR_SCATTER: usize = 6;
/// Minimum factor of the gate, for landmarks that are more exact than was stated.
const NARROWEST: f64 = 1e-4;
/// The median of the chi-squared distribution with three degrees of freedom.
const MEDIAN_CHI2: f64 = 2.366;
/// The first selection after a sample of three noisy pairs has this factor of the gate.
const AFTER_SAMPLE: f64 = 2.5;

/// The indices of the ties that agree; a majority.
///
/// # Errors
/// [`PairFault::Disagreement`] or [`PairFault::Line`].
pub(super) fn find(ties: &[Tie], options: &PairwiseOptions) -> Result<Vec<usize>, PairFault> {
    let samples = samples(ties.len(), options.seed);
    let mut most = 0;
    for factor in WIDER {
        let gate = factor * options.gate_sigmas;
        let Some(best) = best(ties, &samples, gate) else { return Err(PairFault::Line) };
        most = most.max(best.agreeing.len());
        if best.agreeing.len() >= 3 && 2 * best.agreeing.len() > ties.len() {
            return Ok(best.narrowed(ties, gate).agreeing);
        }
    }
    let gate = options.gate_sigmas;
    Err(PairFault::Disagreement { agreeing: most, shared: ties.len(), gate })
}

/// The hypothesis with the least cost of as many samples as it takes to have surely had one without wrong
/// ties, by the share of the ties that agree with the best one so far.
fn best(ties: &[Tie], samples: &[Vec<usize>], gate: f64) -> Option<Hypothesis> {
    let mut best: Option<Hypothesis> = None;
    for (index, sample) in samples.iter().enumerate() {
        if best.as_ref().is_some_and(|best| index >= enough(best.agreeing.len(), ties.len())) {
            break;
        }
        let Some(found) = Hypothesis::grow(ties, sample, gate) else { continue };
        if best.as_ref().is_none_or(|best| found.cost < best.cost) {
            best = Some(found);
        }
    }
    best
}

/// Number of triples after which one without wrong ties was missed with a probability of [`MISSED`]
/// (Fischler and Bolles 1981), if this share of the ties is right.
fn enough(right: usize, all: usize) -> usize {
    let share = right as f64 / all as f64;
    let good = share * share * share;
    // With all of them right, the first sample, of all ties, is enough.
    (MISSED.ln() / (-good).ln_1p()).ceil().max(1.0) as usize
}

/// A transform and the ties that agree with it.
struct Hypothesis {
    t_ij: Isometry3<f64>,
    agreeing: Vec<usize>,
    /// The sum of squared Mahalanobis distances, each at most the squared gate.
    cost: f64,
}

impl Hypothesis {
    /// The transform of a sample, then of the ties that agree with it, until they stay the same.
    fn grow(ties: &[Tie], sample: &[usize], gate: f64) -> Option<Self> {
        let mut found = Self::of(ties, sample, AFTER_SAMPLE * gate)?;
        for _ in 0..5 {
            let next = Self::of(ties, &found.agreeing, gate)?;
            let is_stable = next.agreeing == found.agreeing;
            found = next;
            if is_stable {
                break;
            }
        }
        Some(found)
    }

    fn of(ties: &[Tie], used: &[usize], gate: f64) -> Option<Self> {
        let t_ij = weighted(used.iter().map(|&it| &ties[it]))?;
        let distances: Vec<f64> = ties.iter().map(|it| it.distance2(&t_ij)).collect();
        let agreeing = (0..ties.len()).filter(|&it| distances[it] <= gate * gate).collect();
        let cost = distances.iter().map(|it| it.min(gate * gate)).sum();
        Some(Self { t_ij, agreeing, cost })
    }

    /// Leaves out ties that are far off by the others' own scatter.
    fn narrowed(self, ties: &[Tie], gate: f64) -> Self {
        let mut found = self;
        for _ in 0..5 {
            if found.agreeing.len() < ENOUGH_FOR_SCATTER {
                break;
            }
            let mut distances: Vec<f64> =
                found.agreeing.iter().map(|&it| ties[it].distance2(&found.t_ij)).collect();
            distances.sort_by(f64::total_cmp);
            // Two of the landmarks are spent on the six parameters.
            let count = distances.len() as f64;
            let scatter2 = distances[distances.len() / 2] / MEDIAN_CHI2 * count / (count - 2.0);
            let factor = scatter2.sqrt().clamp(NARROWEST, 1.0);
            let Some(next) = Self::of(ties, &found.agreeing, factor * gate) else { break };
            let is_majority = next.agreeing.len() >= 3 && 2 * next.agreeing.len() > ties.len();
            if !is_majority || next.agreeing == found.agreeing {
                break;
            }
            found = next;
        }
        found
    }
}

/// Sets of ties from which a transform is tried: all of them together, and triples.
fn samples(count: usize, seed: u64) -> Vec<Vec<usize>> {
    let mut samples = vec![(0..count).collect()];
    let triples = count * (count - 1) * (count - 2) / 6;
    if triples <= SAMPLES {
        for a in 0..count {
            for b in a + 1..count {
                samples.extend((b + 1..count).map(|c| vec![a, b, c]));
            }
        }
        return samples;
    }
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    while samples.len() < SAMPLES {
        let sample: Vec<usize> = (0..3).map(|_| dice.random_range(0..count)).collect();
        if sample[0] != sample[1] && sample[1] != sample[2] && sample[0] != sample[2] {
            samples.push(sample);
        }
    }
    samples
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector3};

    use super::*;
    use crate::{
        calibration::{observations::Landmark, point_noise::PointNoise},
        camera::DepthNoise,
    };

    /// Ties of landmarks 3 m before both cameras with noise, of which every `wrong`th has a wrong label.
    fn ties(count: usize, wrong: usize, seed: u64) -> Vec<Tie> {
        let mut dice = ChaCha8Rng::seed_from_u64(seed);
        let noise = PointNoise::new(0.004, DepthNoise::new(0.018, 0.0).unwrap()).unwrap();
        let t_ij = Isometry3::new(Vector3::new(0.5, -0.2, 0.3), Vector3::new(0.2, 0.4, -0.1));
        let mut draw = |half: f64| dice.random_range(-half..half);
        let tie = |index: usize| {
            let far = Point3::new(draw(1.5), draw(1.0), 3.0 + draw(0.5));
            let mut near = t_ij.inverse() * far;
            if index.is_multiple_of(wrong) {
                near += Vector3::new(draw(1.0), draw(1.0), draw(0.5));
            }
            let landmarks = [far, near].map(|it| {
                // The error of the depth is along the ray.
                let along = it.coords * (draw(0.03) / it.z);
                let across = Vector3::new(draw(0.006), draw(0.006), 0.0);
                Landmark { position: it + along + across, label: None, noise }
            });
            Tie::new([index, index], [&landmarks[0], &landmarks[1]])
        };
        (1..=count).map(tie).collect()
    }

    /// Fewer samples find the ties that all samples find.
    #[test]
    fn enough_samples_find_what_all_find() {
        for seed in 0..60 {
            for (count, wrong) in [(6, 100), (12, 100), (12, 5), (20, 4), (30, 3)] {
                let ties = ties(count, wrong, seed);
                let samples = samples(count, 1);
                let gate = PairwiseOptions::default().gate_sigmas;
                let all = samples.iter().filter_map(|it| Hypothesis::grow(&ties, it, gate));
                let plain = all.min_by(|a, b| a.cost.total_cmp(&b.cost)).unwrap();
                let found = best(&ties, &samples, gate).unwrap();
                assert_eq!(found.agreeing, plain.agreeing, "{seed} {count} {wrong}");
                assert!(
                    found.agreeing.iter().filter(|it| (*it + 1).is_multiple_of(wrong)).count() <= 1
                );
            }
        }
    }

    #[test]
    fn the_number_of_samples_follows_the_share_of_right_ties() {
        assert_eq!((enough(10, 10), enough(8, 10)), (1, 29));
        assert!(enough(1, 10) > 20_000 && enough(0, 10) == usize::MAX);
    }
}
