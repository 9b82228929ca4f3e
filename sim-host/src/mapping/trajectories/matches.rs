//! The matches of a piece with others.

use nalgebra::{Matrix3, Vector3};

use crate::mapping::submaps::{Edge, Measured};

/// The matches of a piece.
#[derive(Debug)]
pub(super) struct Matches {
    /// The pose of the piece without these matches.
    pub(super) predicted: Measured,
    pub(super) edges: Vec<Edge>,
    /// For each match, the covariance in the map that it gives the piece.
    pub(super) covariances: Vec<Matrix3<f64>>,
}

impl Matches {
    /// The covariance of the piece's pose in the map, by covariance intersection of the steps and the best match (Julier
    /// and Uhlmann 1997): their errors are correlated, so their information must not be added. `None` without matches.
    pub(super) fn covariance(&self) -> Option<Matrix3<f64>> {
        let steps = self.predicted.covariance.try_inverse()?;
        let both = |its: &Matrix3<f64>| {
            let its = its.try_inverse()?;
            let parts = [0.0, 0.25, 0.5, 0.75, 1.0].map(|part| part * steps + (1.0 - part) * its);
            parts.into_iter().max_by(|a, b| a.determinant().total_cmp(&b.determinant()))
        };
        let all = self.covariances.iter().filter_map(both);
        all.max_by(|a, b| a.determinant().total_cmp(&b.determinant()))?.try_inverse()
    }
}

/// The covariance of independent deviations of x, y and heading.
pub(super) fn covariance(deviations: [f64; 3]) -> Matrix3<f64> {
    Matrix3::from_diagonal(&Vector3::from(deviations.map(|it| it * it)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::submaps::Motion;

    #[test]
    fn a_hundred_matches_that_err_alike_make_a_piece_no_surer_than_one() {
        let of = |steps: [f64; 3], matches: Vec<[f64; 3]>| Matches {
            predicted: Measured { motion: Motion::identity(), covariance: covariance(steps) },
            edges: Vec::new(),
            covariances: matches.into_iter().map(covariance).collect(),
        };
        let near = |found: Matches, expected: [f64; 3]| {
            let off = found.covariance().unwrap() - covariance(expected);
            assert!(off.amax() < 1e-9, "{off}");
        };
        let (sure, unsure) = ([0.03, 0.03, 0.01], [0.3, 0.3, 0.1]);
        near(of(sure, vec![sure; 100]), sure);
        near(of(unsure, vec![sure, unsure]), sure);
        near(of(sure, vec![unsure; 100]), sure);
        assert_eq!(of(sure, Vec::new()).covariance(), None);
        // Along a corridor, only the steps know.
        let along = of(sure, vec![[9.0, 0.02, 0.01]]).covariance().unwrap();
        assert!(along[(0, 0)].sqrt() < 0.05 && along[(1, 1)].sqrt() < 0.031, "{along}");
    }
}
