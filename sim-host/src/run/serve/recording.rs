//! `ubimap record`: the frames of a deployment's cameras, for `calibrate` and `watch`.

use std::{path::PathBuf, sync::Arc, time};

use clap::Args;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use ubimap_protocol::time::{Duration, Instant};

use super::{
    cameras::{Arrived, Cameras},
    clock::Clock,
    sources,
};
use crate::{
    camera::Calibration,
    recording::Recorder,
    run::{
        RunError,
        deployment_file::{DeployedCamera, DeploymentFile},
        interruption,
        options::seconds,
        robots_file,
    },
};

/// How long to wait for a frame, so that signals are noticed.
const WAIT: time::Duration = time::Duration::from_millis(50);

/// Options of `ubimap record`.
#[derive(Args, Clone, Debug)]
pub struct RecordOptions {
    /// The file of the deployment; `ubimap serve` must not run, since both listen to the cameras
    #[arg(value_name = "TOML")]
    pub deployment: PathBuf,

    /// The folder for the recording: new, or empty
    #[arg(value_name = "DIR")]
    pub out: PathBuf,

    /// Duration in seconds; without it, until stopped
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: Option<Duration>,
}

/// Records until the time is up or a signal interrupts. Returns what to print.
///
/// # Errors
/// [`RunError`] if the deployment has no camera, one can't be opened, or the folder can't be written.
pub fn run(options: &RecordOptions) -> Result<String, RunError> {
    let path = &options.deployment;
    let file = DeploymentFile::read(path)?;
    if file.cameras.is_empty() {
        let reason = "has no cameras: nothing to record".into();
        return Err(RunError::Deployment { path: path.clone(), reason });
    }
    let cameras = Arc::new(Cameras::new(file.cameras.len()));
    let ((sources, _files), clock) = (sources::open(&file.cameras, false)?, Clock::new(1.0));
    cameras.start(sources, clock)?;
    let named: Vec<_> = file.cameras.iter().map(|it| (it.name.clone(), placed(it))).collect();
    let mut recorder = Recorder::create_named(&options.out, &named)?;
    robots_file::write(&file.registry, &options.out)?;
    let mut counts = vec![0_u64; named.len()];
    let end = options.duration.map(|duration| Instant(0) + duration);
    while !interruption::is_requested() && end.is_none_or(|end| clock.now() < end) {
        // Frames that were captured before the start all have time zero, and would replace each other.
        if let Some(Arrived { frame, at }) = cameras.take_within(WAIT)
            && frame.captured > Instant(0)
        {
            recorder.write(&frame, at)?;
            counts[frame.camera] += 1;
        }
    }
    let mut text = String::new();
    for ((name, _), count) in named.iter().zip(&counts) {
        text += &format!("camera {name}: {count} frames\n");
    }
    let folder = options.out.display();
    text += &format!("recorded in {folder}; for the cameras' poses: ubimap calibrate {folder}\n");
    Ok(text)
}

/// The camera, where its frames can be read: one without a pose is one metre above the origin and looks down.
fn placed(camera: &DeployedCamera) -> Calibration {
    let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let anywhere = Isometry3::from_parts(Translation3::new(0.0, 0.0, 1.0), down);
    match camera.is_placed {
        true => camera.calibration,
        // The pose is finite.
        false => camera.calibration.at(anywhere).unwrap_or(camera.calibration),
    }
}
