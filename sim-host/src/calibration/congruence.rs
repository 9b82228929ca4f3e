//! Pairing of unlabelled landmarks without a first guess of the transform.
//!
//! A rigid transform keeps distances: three landmarks of camera i and three of camera j with the
//! same three distances are a hypothesis, from which trimmed ICP collects all landmarks that agree.
//! A hypothesis is accepted only if it is much better than chance, and if no other one is nearly as much.
//!
//! "Better than chance" is the number of false alarms of an a contrario test (Desolneux, Moisan and
//! Morel 2000): the expected number of hypotheses with as many agreeing landmarks if all landmarks
//! were independent and uniform. With regularly placed landmarks several transforms pass, which
//! makes the pairing ambiguous.

use std::collections::BTreeSet;

use nalgebra::{Matrix3, Point3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    icp::{Sets, trimmed_icp},
    observations::Landmark,
    pairing::{PairFault, PairwiseOptions},
    tie::{Tie, rotated, weighted},
};

/// Maximum expected number of chance matches of an accepted hypothesis, as a logarithm to base 10.
const ACCEPTED: f64 = -4.0;
/// Maximum ratio of the false alarms of a hypothesis and of the best one, as a logarithm to base 10, at
/// which both are plausible.
const PLAUSIBLE: f64 = 5.0;
/// Maximum number of triples of camera i that are tried; below it, all are.
const TRIPLES: usize = 4000;
/// Maximum number of hypotheses.
const HYPOTHESES: usize = 60_000;
/// Minimum height of a triangle, in standard deviations of the noise.
const FLATTEST: f64 = 3.0;
/// Factor of the gate for the first step of ICP: three noisy landmarks extrapolate badly.
const WIDE: f64 = 2.5;

/// The pairs of landmarks of the only transform that is better than chance.
///
/// # Errors
/// [`PairFault::NoMatch`] or [`PairFault::TwoMatches`].
pub(super) fn find(sets: Sets<'_>, options: &PairwiseOptions) -> Result<Vec<Tie>, PairFault> {
    let search = Search { sets, gate: options.gate_sigmas };
    let gates = [WIDE * search.gate, search.gate];
    let mut seen = BTreeSet::new();
    let mut found: Vec<(f64, Vec<Tie>)> = Vec::new();
    search.hypotheses(options.seed, &mut |triple| {
        let Some(start) = weighted(triple) else { return };
        let Some(ties) = trimmed_icp(start, sets, gates, options.convergence_m) else { return };
        let is_new = seen.insert(ties.iter().map(|it| it.index).collect::<Vec<_>>());
        if is_new && ties.len() > 3 {
            found.push((search.false_alarms(&ties), ties));
        }
    });
    let is_better = |a: &&(f64, Vec<Tie>), b: &&(f64, Vec<Tie>)| a.0.total_cmp(&b.0);
    let best = found.iter().min_by(is_better).filter(|it| it.0 <= ACCEPTED);
    let Some((least, best)) = best else { return Err(PairFault::NoMatch) };
    let rival = found.iter().filter(|(_, ties)| is_other(ties, best)).min_by(is_better);
    match rival {
        Some((alarms, ties)) if *alarms <= ACCEPTED.min(least + PLAUSIBLE) => {
            Err(PairFault::TwoMatches { first: best.len(), second: ties.len() })
        }
        _ => Ok(best.clone()),
    }
}

/// Whether fewer than half of the pairs are among the best ones.
fn is_other(ties: &[Tie], best: &[Tie]) -> bool {
    let shared = ties.iter().filter(|it| best.iter().any(|other| other.index == it.index)).count();
    2 * shared < ties.len()
}

struct Search<'a> {
    sets: Sets<'a>,
    gate: f64,
}

/// Two landmarks of one camera.
#[derive(Clone, Copy)]
struct Leg {
    ends: [usize; 2],
    length_m: f64,
    /// Variance of the length.
    variance: f64,
}

impl Leg {
    fn new(landmarks: &[(usize, &Landmark)], ends: [usize; 2]) -> Self {
        let [one, other] = ends.map(|it| landmarks[it].1);
        let between = other.position - one.position;
        let length_m = between.norm();
        let direction = between / length_m.max(f64::MIN_POSITIVE);
        let covariance = one.covariance() + other.covariance();
        Self { ends, length_m, variance: direction.dot(&(covariance * direction)) }
    }

    fn is_as_long_as(&self, other: &Self, gate: f64) -> bool {
        let difference = self.length_m - other.length_m;
        difference * difference <= gate * gate * (self.variance + other.variance)
    }
}

impl Search<'_> {
    /// Calls `report` with every pair of congruent triangles.
    fn hypotheses(&self, seed: u64, report: &mut dyn FnMut(&[Tie; 3])) {
        let [ours, theirs] = self.sets;
        let between = |a: usize, b: usize| Leg::new(theirs, [a, b]);
        let legs: Vec<Vec<Leg>> =
            (0..theirs.len()).map(|a| (0..theirs.len()).map(|b| between(a, b)).collect()).collect();
        let mut by_length: Vec<Leg> = legs.concat();
        by_length.retain(|it| it.ends[0] != it.ends[1]);
        by_length.sort_by(|a, b| a.length_m.total_cmp(&b.length_m));
        let widest = by_length.iter().map(|it| it.variance).fold(0.0, f64::max);
        let mut left = HYPOTHESES;
        for [a, b, c] in triples(ours.len(), seed) {
            let [ab, bc, ca] = [[a, b], [b, c], [c, a]].map(|ends| Leg::new(ours, ends));
            if self.is_flat([a, b, c]) {
                continue;
            }
            let reach = self.gate * (ab.variance + widest).sqrt();
            let from = by_length.partition_point(|it| it.length_m < ab.length_m - reach);
            for leg in by_length[from..].iter().take_while(|it| it.length_m <= ab.length_m + reach)
            {
                if !ab.is_as_long_as(leg, self.gate) {
                    continue;
                }
                let [x, y] = leg.ends;
                for z in (0..theirs.len()).filter(|&it| it != x && it != y) {
                    if bc.is_as_long_as(&legs[y][z], self.gate)
                        && ca.is_as_long_as(&legs[z][x], self.gate)
                    {
                        let pairs = [(a, x), (b, y), (c, z)];
                        report(&pairs.map(|(i, j)| {
                            Tie::new([ours[i].0, theirs[j].0], [ours[i].1, theirs[j].1])
                        }));
                        left -= 1;
                        if left == 0 {
                            return;
                        }
                    }
                }
            }
        }
    }

    /// Whether the noise is large against the height of a triangle: its third corner does not then
    /// fix the rotation about the longest side.
    fn is_flat(&self, corners: [usize; 3]) -> bool {
        let [a, b, c] = corners.map(|it| self.sets[0][it].1);
        let [ab, ac] = [b, c].map(|it| it.position - a.position);
        let longest = ab.norm().max(ac.norm()).max((ac - ab).norm());
        let sigma_m =
            ([a, b, c].iter().map(|it| it.covariance().trace()).sum::<f64>() / 9.0).sqrt();
        ab.cross(&ac).norm() < longest * FLATTEST * sigma_m
    }

    /// The logarithm of the expected number of hypotheses with as many pairs by chance: the number
    /// of pairs of triples, times the probability that two triples are congruent, times that of as
    /// many further pairs.
    fn false_alarms(&self, ties: &[Tie]) -> f64 {
        let [n, m] = self.sets.map(|it| it.len() as f64);
        let tests = n * (n - 1.0) * (n - 2.0) / 6.0 * (m * (m - 1.0) * (m - 2.0));
        let t_ij = weighted(ties).unwrap_or_default();
        let count = ties.len() as f64;
        let spread = ties
            .iter()
            .map(|tie| {
                (tie.covariance[0] + rotated(&t_ij, &tie.covariance[1])).determinant().sqrt()
            })
            .sum::<f64>()
            / count;
        let sigma_m = ties.iter().map(Tie::sigma_m).sum::<f64>() / count;
        let sides = extents(self.sets[1]).map(|it| it.max(2.0 * self.gate * sigma_m));
        let longest = sides.norm();
        let congruent = (4.0 * self.gate * sigma_m / longest).min(1.0);
        let ellipsoid = 4.0 / 3.0 * std::f64::consts::PI * self.gate.powi(3) * spread;
        let hit = (m * ellipsoid / sides.product()).min(1.0);
        (tests * congruent.powi(3)).log10() + log_tail(n as usize - 3, ties.len() - 3, hit)
    }
}

/// The sides of the box around the landmarks along their principal axes, in metres.
fn extents(landmarks: &[(usize, &Landmark)]) -> Vector3<f64> {
    let count = landmarks.len() as f64;
    let points = landmarks.iter().map(|it| it.1.position);
    let mean: Vector3<f64> = points.clone().map(|it| it.coords).sum::<Vector3<f64>>() / count;
    let scatter: Matrix3<f64> =
        points.clone().map(|it| (it.coords - mean) * (it.coords - mean).transpose()).sum();
    let axes = scatter.symmetric_eigen().eigenvectors;
    Vector3::from_fn(|axis, _| {
        let along = |it: Point3<f64>| it.coords.dot(&axes.column(axis));
        let (low, high) = points
            .clone()
            .map(along)
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), it| {
                (low.min(it), high.max(it))
            });
        high - low
    })
}

/// The logarithm to base 10 of the probability of at least `least` hits of `count`.
fn log_tail(count: usize, least: usize, probability: f64) -> f64 {
    if least == 0 || probability >= 1.0 {
        return 0.0;
    }
    let mut log_choose = 0.0;
    let mut terms = Vec::new();
    for hits in 0..=count {
        if hits > 0 {
            log_choose += ((count - hits + 1) as f64 / hits as f64).log10();
        }
        if hits >= least {
            let misses = (count - hits) as f64;
            terms.push(
                log_choose
                    + hits as f64 * probability.log10()
                    + misses * (1.0 - probability).log10(),
            );
        }
    }
    let greatest = terms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    greatest + terms.iter().map(|it| 10f64.powf(it - greatest)).sum::<f64>().log10()
}

/// All triples of so many landmarks, or a random sample.
fn triples(count: usize, seed: u64) -> Vec<[usize; 3]> {
    let all = count * (count - 1) * (count - 2) / 6;
    if all <= TRIPLES {
        let pairs = (0..count).flat_map(|a| (a + 1..count).map(move |b| [a, b]));
        return pairs.flat_map(|[a, b]| (b + 1..count).map(move |c| [a, b, c])).collect();
    }
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    let mut sample = Vec::with_capacity(TRIPLES);
    while sample.len() < TRIPLES {
        let [a, b, c] = [(); 3].map(|()| dice.random_range(0..count));
        if a != b && b != c && c != a {
            sample.push([a, b, c]);
        }
    }
    sample
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tails_are_those_of_the_binomial_distribution() {
        assert_eq!(log_tail(5, 0, 0.1), 0.0);
        assert!((log_tail(2, 1, 0.5) - 0.75f64.log10()).abs() < 1e-12);
        assert!((log_tail(3, 3, 1e-30) + 90.0).abs() < 1e-9);
        assert_eq!(log_tail(1, 2, 0.5), f64::NEG_INFINITY);
    }
}
