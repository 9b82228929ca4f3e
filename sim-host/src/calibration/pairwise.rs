//! The transform between two cameras that see the same landmarks.

use nalgebra::{DMatrix, Isometry3, Matrix6};

use super::{
    congruence, consensus,
    observations::{CameraObservations, Landmark},
    pairing::{PairFault, PairwiseOptions},
    tie::{self, Tie, closed_form_covariance},
};

/// The transform between two cameras: an edge of the transformation graph.
#[derive(Clone, Debug, PartialEq)]
pub struct PairTransform {
    /// The paper's `T_ij`, taken as in `T_0k = T_0i T_ij T_jk`: the pose of camera j in the frame of
    /// camera i, in metres.
    pub t_ij: Isometry3<f64>,
    /// Its covariance about and along the axes of i, in radians and metres.
    pub covariance: Matrix6<f64>,
    /// The landmarks that agree with it, by their indices in i and j.
    pub pairs: Vec<[usize; 2]>,
    /// Pairs of landmarks with equal labels that do not agree with it.
    pub rejected: Vec<[usize; 2]>,
    /// Whether the landmarks were paired by their labels.
    pub is_labelled: bool,
}

/// Minimum distance of the landmarks from the line through them (root mean square), in standard
/// deviations of their noise.
const WIDTH_SIGMAS: f64 = 3.0;
/// Maximum standard deviation of an angle, in radians.
const MAX_ANGLE_SIGMA_RAD: f64 = 0.35;

/// The transform between cameras i and j: from the labels if they have at least three in common,
/// otherwise from the arrangement of their unlabelled landmarks.
///
/// # Errors
/// Every [`PairFault`].
pub fn pair_transform(
    cameras: [&CameraObservations; 2],
    options: &PairwiseOptions,
) -> Result<PairTransform, PairFault> {
    let ties = labelled(cameras);
    if ties.len() >= 3 {
        let agreeing = consensus::find(&ties, options)?;
        return conclude(&ties, &agreeing, true);
    }
    let unlabelled = cameras.map(|it| {
        let landmarks = it.landmarks.iter().enumerate();
        landmarks.filter(|(_, it)| it.label.is_none()).collect::<Vec<(usize, &Landmark)>>()
    });
    if unlabelled.iter().any(|it| it.len() < 3) {
        return Err(PairFault::TooFew { shared: ties.len() });
    }
    let ties = congruence::find([&unlabelled[0], &unlabelled[1]], options)?;
    conclude(&ties, &(0..ties.len()).collect::<Vec<_>>(), false)
}

/// The landmarks of both cameras that have equal labels.
fn labelled([first, second]: [&CameraObservations; 2]) -> Vec<Tie> {
    let by_label: std::collections::BTreeMap<&str, usize> = second
        .landmarks
        .iter()
        .enumerate()
        .filter_map(|(index, it)| Some((it.label.as_deref()?, index)))
        .collect();
    let ties = first.landmarks.iter().enumerate().filter_map(|(index, landmark)| {
        let other = *by_label.get(landmark.label.as_deref()?)?;
        Some(Tie::new([index, other], [landmark, &second.landmarks[other]]))
    });
    ties.collect()
}

/// The closed form of the agreeing ties.
fn conclude(
    ties: &[Tie],
    agreeing: &[usize],
    is_labelled: bool,
) -> Result<PairTransform, PairFault> {
    let used: Vec<&Tie> = agreeing.iter().map(|&it| &ties[it]).collect();
    let t_ij = tie::closed_form(used.iter().copied()).ok_or(PairFault::Line)?;
    let covariance = closed_form_covariance(&t_ij, &used).ok_or(PairFault::Line)?;
    let angles: nalgebra::Matrix3<f64> = covariance.fixed_view::<3, 3>(0, 0).into();
    let worst_rad = angles.symmetric_eigenvalues().max().sqrt();
    let sigma_m = used.iter().map(|it| it.sigma_m()).sum::<f64>() / used.len() as f64;
    let is_line = [0, 1].iter().any(|&camera| width_m(&used, camera) < WIDTH_SIGMAS * sigma_m);
    if is_line || worst_rad.is_nan() || worst_rad > MAX_ANGLE_SIGMA_RAD {
        return Err(PairFault::Line);
    }
    let rejected = (0..ties.len()).filter(|it| !agreeing.contains(it)).map(|it| ties[it].index);
    Ok(PairTransform {
        t_ij,
        covariance,
        pairs: used.iter().map(|it| it.index).collect(),
        rejected: rejected.collect(),
        is_labelled,
    })
}

/// Root mean square of the distances of points from the line through them, in metres: from the
/// second singular value, so that the width of points in a plane counts.
fn width_m(ties: &[&Tie], camera: usize) -> f64 {
    let count = ties.len() as f64;
    let mean =
        ties.iter().map(|it| it.point[camera].coords).sum::<nalgebra::Vector3<f64>>() / count;
    let centred = DMatrix::from_fn(3, ties.len(), |row, index| {
        (ties[index].point[camera].coords - mean)[row]
    });
    let mut values: Vec<f64> = centred.singular_values().iter().copied().collect();
    values.sort_by(f64::total_cmp);
    let second = values.len().checked_sub(2).map_or(0.0, |index| values[index]);
    second / count.sqrt()
}
