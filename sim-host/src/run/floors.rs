//! The floors that recorded cameras see, against the poses that are stated for them.

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
/// corrects the cameras of `frames` as `trust` says. `samples` are the same frames once more.
///
/// # Errors
/// [`RunError::Frames`].
pub(super) fn check(
    samples: RecordedFrames,
    frames: &mut RecordedFrames,
    trust: TrustFloor,
) -> Result<Vec<Option<SeenFloor>>, RunError> {
    let samples = sample(samples, frames.cameras())?;
    let mut poses = Vec::new();
    let mut floors = Vec::new();
    for ((camera, samples), name) in frames.cameras().iter().zip(&samples).zip(frames.names()) {
        let stated = camera.pose().copied().unwrap_or_default();
        let found = samples.as_ref().and_then(|samples| {
            FloorPlane::find(samples, |plane| {
                let error = FloorError::new(&stated, &plane.normal, plane.height_m);
                error.height_m.abs() < MOST_M && error.tilt_rad.to_degrees() < MOST_DEG
            })
        });
        let plane = found.filter(|plane| plane.share >= LEAST_SHARE);
        let is_enough = samples.as_ref().is_some_and(DepthSamples::is_enough);
        let floor = plane.map(|plane| {
            let error = FloorError::new(&stated, &plane.normal, plane.height_m);
            seen(&plane, &error, trust, is_enough)
        });
        match floor {
            // A few images tell little: their noise is not averaged.
            Some(floor) if is_clear(&floor) && (is_enough || floor.is_corrected) => {
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
            Some(floor) if !is_enough => log::info!(
                "{name}: the floor is off by {floor}, by too few images to be sure; --trust-floor always \
                 corrects it all the same"
            ),
            Some(floor) => log::info!("{name}: the floor is off by {floor}"),
            None => {
                log::info!("{name}: height and tilt are not checked: {}", unseen(found.as_ref()))
            }
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

/// Why a camera has no floor, if this plane was found.
fn unseen(found: Option<&FloorPlane>) -> String {
    match found {
        Some(plane) => format!(
            "the plane at z = 0 fills {:.0} % of the view; below {:.0} % it may be a seat",
            100.0 * plane.share,
            100.0 * LEAST_SHARE
        ),
        None => format!(
            "no plane within {MOST_M} m and {MOST_DEG} degrees of z = 0 (is z up in the pose, and the floor at 0?)"
        ),
    }
}

fn seen(plane: &FloorPlane, error: &FloorError, trust: TrustFloor, is_enough: bool) -> SeenFloor {
    let floor = SeenFloor {
        height_m: error.height_m,
        tilt_deg: error.tilt_rad.to_degrees(),
        share: plane.share,
        is_corrected: false,
    };
    let is_corrected = match trust {
        TrustFloor::Auto => is_clear(&floor) && is_enough && plane.share >= TRUSTED_SHARE,
        TrustFloor::Always => true,
        TrustFloor::Never => false,
    };
    SeenFloor { is_corrected, ..floor }
}

fn is_clear(floor: &SeenFloor) -> bool {
    floor.height_m.abs() > CLEAR_M || floor.tilt_deg > CLEAR_DEG
}
