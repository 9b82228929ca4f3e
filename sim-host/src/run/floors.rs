//! The floors that recorded cameras see, against the poses that are stated for them.

use std::path::PathBuf;

use ubimap_protocol::time::{Duration, Instant};

use super::{RunError, interruption, options::TrustFloor};
use crate::{
    camera::{Calibration, FrameSource},
    perception::{DepthSamples, FloorError, FloorPlane},
    recording::RecordedFrames,
    report::SeenFloor,
};

/// Minimum interval between two depth images of one camera.
const INTERVAL: Duration = Duration::from_millis(290);
/// Errors above which a floor is clearly off: metres and degrees.
const CLEAR_M: f64 = 0.01;
const CLEAR_DEG: f64 = 0.5;
/// Maximum errors of a stated pose; a plane further off is no floor: metres and degrees.
const MOST_M: f64 = 0.5;
const MOST_DEG: f64 = 15.0;
/// Minimum share of the measured pixels of a floor, and of one that is trusted. A smaller plane may be
/// a seat.
const LEAST_SHARE: f64 = 0.05;
const TRUSTED_SHARE: f64 = 0.1;

/// Finds the floor of each fixed camera in the first images of a recording. Prints how far it is off, and
/// corrects the cameras of `frames`, which have the same folders, as `trust` says.
///
/// # Errors
/// [`RunError::Frames`].
pub(super) fn check(
    folders: &[PathBuf],
    frames: &mut RecordedFrames,
    trust: TrustFloor,
) -> Result<Vec<Option<SeenFloor>>, RunError> {
    let samples = sample(RecordedFrames::open_unplaced(folders)?, frames.cameras())?;
    let mut poses = Vec::new();
    let mut floors = Vec::new();
    for ((camera, samples), name) in frames.cameras().iter().zip(&samples).zip(frames.names()) {
        let stated = camera.pose().copied().unwrap_or_default();
        let plane = samples.as_ref().filter(|it| it.is_enough()).and_then(|samples| {
            FloorPlane::find(samples, |plane| {
                let error = FloorError::new(&stated, &plane.normal, plane.height_m);
                error.height_m.abs() < MOST_M && error.tilt_rad.to_degrees() < MOST_DEG
            })
        });
        let plane = plane.filter(|plane| plane.share >= LEAST_SHARE);
        let floor = plane.map(|plane| {
            seen(&plane, &FloorError::new(&stated, &plane.normal, plane.height_m), trust)
        });
        match floor {
            Some(floor) if is_clear(&floor) => {
                let advice = match (floor.is_corrected, trust) {
                    (true, _) => "",
                    (false, TrustFloor::Never) => {
                        "; correct its pose, or leave out --trust-floor never"
                    }
                    (false, _) => {
                        "; it fills too little of the view to be trusted: correct the pose, or use \
                                   --trust-floor always"
                    }
                };
                log::warn!("{name}: the floor is off by {floor}{advice}");
            }
            Some(floor) => log::info!("{name}: the floor is off by {floor}"),
            None => log::info!("{name}: no floor found"),
        }
        let corrected = plane.filter(|_| floor.is_some_and(|floor| floor.is_corrected));
        poses.push(corrected.map_or(stated, |plane| plane.level(&stated)));
        floors.push(floor);
    }
    // They are finite, as the stated ones are.
    let _ = frames.place(&poses);
    Ok(floors)
}

/// The first depth images of each camera.
fn sample(
    mut frames: RecordedFrames,
    cameras: &[Calibration],
) -> Result<Vec<Option<DepthSamples>>, RunError> {
    let of = |camera: &Calibration| {
        camera.depth.map(|lens| DepthSamples::new(lens.intrinsics(), camera.depth_noise))
    };
    let mut samples: Vec<Option<DepthSamples>> = cameras.iter().map(of).collect();
    let mut next = vec![Instant(0); cameras.len()];
    while !interruption::is_requested()
        && samples.iter().flatten().any(|it| !it.is_full())
        && let Some(now) = frames.next_arrival()
    {
        while let Some(frame) = frames.poll(now) {
            let (Some(Some(samples)), Some(depth)) = (samples.get_mut(frame.camera), &frame.depth)
            else {
                continue;
            };
            if frame.captured >= next[frame.camera] && !samples.is_full() {
                next[frame.camera] = frame.captured + INTERVAL;
                samples.add(depth);
            }
        }
    }
    match frames.take_fault() {
        Some(fault) => Err(fault.into()),
        None => Ok(samples),
    }
}

fn seen(plane: &FloorPlane, error: &FloorError, trust: TrustFloor) -> SeenFloor {
    let floor = SeenFloor {
        height_m: error.height_m,
        tilt_deg: error.tilt_rad.to_degrees(),
        share: plane.share,
        is_corrected: false,
    };
    let is_corrected = match trust {
        TrustFloor::Auto => is_clear(&floor) && plane.share >= TRUSTED_SHARE,
        TrustFloor::Always => true,
        TrustFloor::Never => false,
    };
    SeenFloor { is_corrected, ..floor }
}

fn is_clear(floor: &SeenFloor) -> bool {
    floor.height_m.abs() > CLEAR_M || floor.tilt_deg > CLEAR_DEG
}
