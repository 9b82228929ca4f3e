//! A simulated calibration: one robot is steered through the overlaps of the cameras, whose poses
//! are then those that its markers give. True poses serve for the tour and the comparison alone.

use ubimap_protocol::{
    time::{Duration, Instant},
    units::Millimetres,
};

use super::{RunError, calibrate::CalibrateFault};
use crate::{
    calibration::{
        calibrating::{Calibrated, Options, calibrate},
        landmark_finder::LandmarkFinder,
    },
    camera::{Calibration, FrameSource},
    deployment::registry::Registry,
    report::CalibrationErrors,
    world::{Scenario, WallGrid, World},
};

/// Minimum duration of a calibration.
const LEAST: Duration = Duration::from_secs(60);
/// Maximum duration, if people keep the robot from completing its tour.
const MOST: Duration = Duration::from_secs(600);
/// Distance from a stop of the tour at which a robot has reached it, in metres.
const ARRIVED_M: f64 = 0.1;

/// Calibrates the cameras of a scenario by what they see while its first robot is steered through
/// their views. `resolution` is the side of the cells of the tour. The pose of the first camera is known. Returns all cameras in the poses found.
///
/// # Errors
/// [`RunError::Calibrate`] if a camera gets no pose, with the reason.
pub fn calibrated(
    scenario: &Scenario,
    walls: Option<&WallGrid>,
    resolution: Millimetres,
    registry: &Registry,
    seed: u64,
) -> Result<(Vec<Calibration>, CalibrationErrors), RunError> {
    let mut scenario = scenario.clone();
    scenario.robots.truncate(1);
    let world = World::new(&scenario, walls, resolution, seed)?;
    let tour = world.tour();
    if tour.is_empty() {
        let reason = "no marker of a robot can be in the pictures of two cameras at once; let their views overlap more";
        return Err(CalibrateFault::of("--calibrate", &reason).into());
    }
    if let Some(robot) = scenario.robots.first_mut() {
        robot.route.waypoints_m.clone_from(&tour);
    }
    let mut world = World::new(&scenario, walls, resolution, seed)?;
    let cameras = FrameSource::cameras(&world).to_vec();
    let mut finder = LandmarkFinder::new(&cameras, registry.markers());
    let mut ahead = &tour[..];
    let mut now = Instant(0);
    while let Some(next) = FrameSource::next_arrival(&world)
        && (now < Instant(0) + LEAST || !ahead.is_empty())
        && now < Instant(0) + MOST
    {
        now = next;
        while let Some(frame) = FrameSource::poll(&mut world, now) {
            finder.add(&frame);
        }
        let at = world.robots().first().map(|robot| robot.truth());
        if let [[x, y], rest @ ..] = ahead
            && at.is_none_or(|at| libm::hypot(at.x.metres() - x, at.y.metres() - y) < ARRIVED_M)
        {
            ahead = rest;
        }
    }
    log::info!(
        "calibration: {} of {} stops of the tour in {:.0} s",
        tour.len() - ahead.len(),
        tour.len(),
        now.micros() as f64 / 1e6
    );

    let refuse = |reason: String| CalibrateFault::of("--calibrate", &reason);
    let names: Vec<String> = (0..cameras.len()).map(|index| format!("camera-{index:02}")).collect();
    let (observations, unseen) = finder.finish(&names);
    if let Some((camera, reason)) = unseen.first() {
        return Err(refuse(format!("{}: {reason}", names[*camera])).into());
    }
    let reference_pose = cameras.first().and_then(|camera| camera.pose().copied());
    let options = Options { reference_pose, ..Options::default() };
    let found = calibrate(&observations, &options).map_err(|error| refuse(error.to_string()))?;
    let moved = cameras.iter().zip(&found.cameras).zip(&names).map(|((camera, found), name)| {
        let pose =
            found.pose.ok_or_else(|| refuse(format!("no overlap ties {name} to the others")))?;
        camera.at(pose).map_err(|error| refuse(format!("{name}: {error}")))
    });
    let moved = moved.collect::<Result<Vec<_>, _>>()?;
    Ok((moved, errors(&cameras, &found)))
}

/// The errors of the poses except the reference's.
fn errors(cameras: &[Calibration], found: &Calibrated) -> CalibrationErrors {
    let pairs = cameras.iter().zip(&found.cameras).skip(1);
    let errors = pairs.filter_map(|(camera, found)| {
        let (truth, pose) = (camera.pose()?, found.pose?);
        let metres = (pose.translation.vector - truth.translation.vector).norm();
        let radians = pose.rotation.angle_to(&truth.rotation);
        let in_sigmas = [metres / found.position_sigma_m(), radians / found.angle_sigma_rad()];
        Some(([metres, radians.to_degrees()], in_sigmas))
    });
    let errors: Vec<([f64; 2], [f64; 2])> = errors.collect();
    let most = |kind: usize| errors.iter().map(|(error, _)| error[kind]).fold(0.0, f64::max);
    CalibrationErrors {
        landmarks: found.edges.iter().map(|edge| edge.edge.transform.pairs.len() as u64).sum(),
        position_m: most(0),
        angle_deg: most(1),
        in_sigmas: errors.into_iter().map(|(_, in_sigmas)| in_sigmas).collect(),
    }
}
