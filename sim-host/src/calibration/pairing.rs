//! How landmarks of two cameras are paired, and why they can't be.

/// How landmarks of two cameras are paired.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairwiseOptions {
    /// Maximum distance between paired landmarks, in standard deviations of their noise.
    pub gate_sigmas: f64,
    /// The paper's `s`: ICP has converged when the mean distance of the pairs changes by less, in
    /// metres.
    pub convergence_m: f64,
    /// Seed of the random samples.
    pub seed: u64,
}

impl Default for PairwiseOptions {
    fn default() -> Self {
        Self { gate_sigmas: 4.0, convergence_m: 1e-6, seed: 1 }
    }
}

/// Why there is no transform between two cameras.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum PairFault {
    /// Too few landmarks in common.
    #[error("{shared} landmarks in common; at least 3 are needed")]
    TooFew {
        /// Number of landmarks with labels in common.
        shared: usize,
    },
    /// Less than a majority of the labelled landmarks agree.
    #[error(
        "failed: only {agreeing} of {shared} common landmarks agree within {gate} sigma; check labels and noise"
    )]
    Disagreement {
        /// Number of landmarks that agree with the best transform.
        agreeing: usize,
        /// Number of landmarks with labels in common.
        shared: usize,
        /// The gate in standard deviations.
        gate: f64,
    },
    /// No pairing of unlabelled landmarks is better than chance.
    #[error("failed: no pairing of the unlabelled landmarks is better than chance")]
    NoMatch,
    /// Two pairings of unlabelled landmarks are both better than chance.
    #[error(
        "ambiguous: {first} landmarks agree with one transform, {second} with another; place them \
         irregularly, or label them"
    )]
    TwoMatches {
        /// Number of landmarks that agree with the best transform.
        first: usize,
        /// Number of landmarks that agree with another one.
        second: usize,
    },
    /// The landmarks are on a line, within their noise.
    #[error("ambiguous: the common landmarks are nearly on a line; place one beside it")]
    Line,
    /// The transform contradicts those of other cameras.
    #[error("failed: its landmarks contradict those of the other cameras")]
    Contradiction,
}

impl PairFault {
    /// Number of landmarks that the cameras have in common, as far as is known.
    pub fn shared(&self) -> usize {
        match *self {
            Self::TooFew { shared } | Self::Disagreement { shared, .. } => shared,
            Self::TwoMatches { first, .. } => first,
            Self::NoMatch | Self::Line | Self::Contradiction => 0,
        }
    }
}
