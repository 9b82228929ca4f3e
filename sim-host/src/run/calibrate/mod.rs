//! `ubimap calibrate`: the cameras' poses from landmarks that they see in common.

mod fault;
pub mod options;

use std::path::Path;

use super::RunError;
use crate::{
    calibration::{
        calibrating::{Calibrated, CalibratedCamera, Options, calibrate},
        observations::Observations,
        pairing::{PairFault, PairwiseOptions},
        refine::Weighting,
    },
    camera::{CamerasFile, MountedCamera},
    files,
    report::{CalibrateReport, CameraResult, EdgeResult, FailedPair, FloorResult},
};
pub use fault::CalibrateFault;
use options::CalibrateOptions;

/// The results of a calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct CalibrateOutcome {
    /// The figures.
    pub report: CalibrateReport,
    /// The calibrated cameras, as the text of a `cameras.toml`.
    pub cameras: String,
}

/// Calibrates the cameras of a file of observations.
///
/// # Errors
/// [`RunError::Calibrate`] if a file is invalid or no camera can be calibrated.
pub fn run(options: &CalibrateOptions) -> Result<CalibrateOutcome, RunError> {
    let path = &options.observations;
    let observations =
        Observations::parse(&read(path)?).map_err(|error| CalibrateFault::in_file(path, &error))?;
    let reference = match &options.reference {
        None => 0,
        Some(name) => observations.camera(name).ok_or_else(|| {
            let reason = format!("no camera is named {name:?}, which --reference gives");
            CalibrateFault::in_file(path, &reason)
        })?,
    };
    let mounted = match &options.cameras {
        Some(path) => CamerasFile::parse(&read(path)?)
            .map_err(|reason| CalibrateFault::in_file(path, &reason))?,
        None => CamerasFile::default(),
    };
    let name = &observations.cameras[reference].name;
    let reference_pose = mounted.named(name).and_then(MountedCamera::pose);
    if let (Some(path), None) = (&options.cameras, reference_pose) {
        let reason =
            format!("no camera is named {name:?}, which is the reference; choose with --reference");
        return Err(CalibrateFault::in_file(path, &reason).into());
    }
    let weighting = if options.unweighted { Weighting::Unweighted } else { Weighting::Covariance };
    let pairwise = PairwiseOptions { gate_sigmas: options.gate, ..PairwiseOptions::default() };
    let calibrated =
        calibrate(&observations, &Options { reference, reference_pose, weighting, pairwise })
            .map_err(|error| CalibrateFault::in_file(path, &error))?;
    let report = summarise(path, &observations, &calibrated, reference, weighting);
    Ok(CalibrateOutcome { cameras: cameras_file(&report, &calibrated, &mounted), report })
}

fn read(path: &Path) -> Result<String, CalibrateFault> {
    files::read_settings(path).map_err(|error| CalibrateFault::in_file(path, &error))
}

fn summarise(
    path: &Path,
    observations: &Observations,
    calibrated: &Calibrated,
    reference: usize,
    weighting: Weighting,
) -> CalibrateReport {
    let name = |camera: usize| observations.cameras[camera].name.clone();
    let cameras = calibrated.cameras.iter().enumerate().map(|(index, camera)| {
        let CalibratedCamera { residual_m, landmarks, .. } = *camera;
        CameraResult {
            name: name(index),
            is_tied: camera.pose.is_some(),
            residual_m,
            position_sigma_m: camera.position_sigma_m(),
            angle_sigma_deg: camera.angle_sigma_rad().to_degrees(),
            landmarks: landmarks as u64,
            neighbours: camera.neighbours.iter().map(|&it| name(it)).collect(),
            floor: camera.floor.map(|floor| FloorResult {
                height_m: floor.height_m,
                tilt_deg: floor.tilt_rad.to_degrees(),
            }),
        }
    });
    let edges = calibrated.edges.iter().map(|it| EdgeResult {
        cameras: it.edge.cameras.map(name),
        landmarks: it.edge.transform.pairs.len() as u64,
        rejected: it.edge.transform.rejected.len() as u64,
        is_labelled: it.edge.transform.is_labelled,
        residual_m: it.residual_m,
    });
    // Cameras without a common view never match: only what was expected to work is a failure.
    let failures = calibrated.failures.iter().filter(|it| it.fault != PairFault::NoMatch);
    CalibrateReport {
        observations: path.display().to_string(),
        reference: name(reference),
        weighting: match weighting {
            Weighting::Covariance => "covariance",
            Weighting::Unweighted => "unweighted",
        },
        noise_ratio: calibrated.noise_ratio,
        cameras: cameras.collect(),
        edges: edges.collect(),
        failures: failures
            .map(|it| FailedPair { cameras: it.cameras.map(name), reason: it.fault.to_string() })
            .collect(),
        ..CalibrateReport::default()
    }
}

/// The calibrated cameras as a `cameras.toml`, with the other keys of `mounted`.
fn cameras_file(
    report: &CalibrateReport,
    calibrated: &Calibrated,
    mounted: &CamerasFile,
) -> String {
    let cameras = calibrated.cameras.iter().zip(&report.cameras).filter_map(|(camera, result)| {
        let mut written = mounted.named(&result.name).cloned().unwrap_or_default();
        written.name.clone_from(&result.name);
        written.set_pose(&camera.pose?);
        Some(written)
    });
    let file = CamerasFile { cameras: cameras.collect() };
    let heading: String = report.to_string().lines().map(|line| format!("# {line}\n")).collect();
    format!("{heading}\n{}", file.to_toml())
}
