//! `ubimap calibrate`: the cameras' poses from landmarks that they see in common.

mod fault;
pub mod options;

use std::path::Path;

use nalgebra::Isometry3;

use super::{RunError, interruption, progress::Progress, robots_file};
use crate::{
    calibration::{
        calibrating::{CalibrateError, Calibrated, CalibratedCamera, Options, calibrate},
        landmark_finder::LandmarkFinder,
        observations::Observations,
        pairing::{PairFault, PairwiseOptions},
        refine::Weighting,
    },
    camera::{CamerasFile, FrameSource, MountedCamera},
    files,
    recording::{Reading, RecordedFrames},
    report::{CalibrateReport, CameraResult, EdgeResult, FailedPair, FloorResult, UnseenCamera},
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

/// Calibrates the cameras of a file of observations or of a recording.
///
/// # Errors
/// [`RunError::Calibrate`] if a file is invalid or no camera can be calibrated; [`RunError::Frames`]
/// and [`RunError::Robots`] for a recording that can't be read.
pub fn run(options: &CalibrateOptions) -> Result<CalibrateOutcome, RunError> {
    let path = &options.observations;
    let Seen { observations, stated, unseen } =
        if path.is_dir() { recorded(path, options)? } else { listed(path)? };
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
    let reference_pose = reference_pose.or(stated.get(reference).copied().flatten());
    let weighting = if options.unweighted { Weighting::Unweighted } else { Weighting::Covariance };
    let pairwise = PairwiseOptions { gate_sigmas: options.gate, ..PairwiseOptions::default() };
    let calibrated =
        calibrate(&observations, &Options { reference, reference_pose, weighting, pairwise })
            .map_err(|error| CalibrateFault::in_file(path, &with_reasons(&error, &unseen)))?;
    let mut report = summarise(path, &observations, &calibrated, reference, weighting);
    report.unseen = unseen;
    Ok(CalibrateOutcome { cameras: cameras_file(&report, &calibrated, &mounted), report })
}

/// What cameras have seen.
struct Seen {
    observations: Observations,
    /// The poses that a recording states, by camera.
    stated: Vec<Option<Isometry3<f64>>>,
    /// The cameras without landmarks.
    unseen: Vec<UnseenCamera>,
}

/// The landmarks of a file of observations.
fn listed(path: &Path) -> Result<Seen, RunError> {
    let observations =
        Observations::parse(&read(path)?).map_err(|error| CalibrateFault::in_file(path, &error))?;
    Ok(Seen { observations, stated: Vec::new(), unseen: Vec::new() })
}

/// The landmarks in the frames of a recording.
fn recorded(path: &Path, options: &CalibrateOptions) -> Result<Seen, RunError> {
    let folders = [path.to_owned()];
    let reading = Reading { may_lack_poses: true, depth_per_metre: options.unit.per_metre };
    let mut frames = RecordedFrames::open_with(&folders, reading)?;
    let registry = robots_file::find(options.robots.as_deref(), &folders)?;
    if registry.robots.is_empty() {
        let reason = "no robot, whose marker could be a landmark; name a robots.toml with --robots";
        return Err(CalibrateFault::in_file(path, &reason).into());
    }
    let mut finder = LandmarkFinder::new(frames.cameras(), registry.markers());
    let progress = Progress::new(frames.end());
    while !interruption::is_requested()
        && let Some(now) = frames.next_arrival()
    {
        while let Some(frame) = frames.poll(now) {
            finder.add(&frame);
        }
        progress.at(now);
    }
    drop(progress);
    if let Some(fault) = frames.take_fault() {
        return Err(fault.into());
    }
    let names = frames.names();
    let (observations, unseen) = finder.finish(names);
    let unseen = unseen.into_iter().map(|(camera, reason)| UnseenCamera {
        name: names[camera].clone(),
        reason: reason.to_string(),
    });
    let stated = frames.stated_poses().map(Option::<&_>::copied).collect();
    Ok(Seen { observations, stated, unseen: unseen.collect() })
}

/// The error, and why cameras have no landmarks.
fn with_reasons(error: &CalibrateError, unseen: &[UnseenCamera]) -> String {
    let reasons = unseen.iter().map(|camera| format!("; {}: {}", camera.name, camera.reason));
    std::iter::once(error.to_string()).chain(reasons).collect()
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
