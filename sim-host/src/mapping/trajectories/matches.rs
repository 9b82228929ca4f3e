//! The matches of a piece with others.

use nalgebra::{Matrix3, Vector3};

use crate::mapping::submaps::{Edge, Measured};

/// The matches of a piece.
#[derive(Debug)]
pub(super) struct Matches {
    /// Where the piece is without them.
    pub(super) predicted: Measured,
    pub(super) edges: Vec<Edge>,
    /// With which covariance in the map each puts the piece.
    pub(super) covariances: Vec<Matrix3<f64>>,
}

impl Matches {
    /// How sure they make the piece: covariance of its pose in the map. Its steps and its matches err for the same
    /// reasons, so that their information is not added (covariance intersection: Julier and Uhlmann 1997); the best match
    /// counts. `None` without any.
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
