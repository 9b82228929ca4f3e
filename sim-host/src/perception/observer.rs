//! Turns frames into observations: localises the robots, and perceives cells and objects.

use std::collections::BTreeMap;

use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Pose, RobotId},
};

use super::{
    eye::{Eye, FrameError},
    footprint::Footprint,
    markers::{Identifier, Mount},
    ray_table::Survey,
    robots::{Localiser, RegistryError, SightingEvent},
};
use crate::{
    camera::{Calibration, Frame, Observation},
    timing::SIGHTING_HOLDS,
};

/// Minimum interval between processed depth images of one camera: people walk 0.25 m in this time.
const LOOK_INTERVAL: Duration = Duration::from_millis(190);

/// Perception of all cameras.
#[derive(Debug)]
pub struct Observer {
    localiser: Localiser,
    eyes: Vec<Option<Camera>>,
    footprints: BTreeMap<RobotId, Footprint>,
    /// The time and pose of each robot's last localisation.
    localised: BTreeMap<RobotId, (Instant, Pose)>,
}

#[derive(Debug)]
struct Camera {
    eye: Eye,
    next_look: Instant,
    /// The current fault of the camera's frames, once it has been reported.
    fault: Option<FrameError>,
}

impl Observer {
    /// An observer for these cameras and robots, with the robots' markers and footprints. Memory:
    /// 40 bytes for each pixel of each depth sensor.
    ///
    /// # Errors
    /// Every [`RegistryError`].
    pub fn new(
        cameras: &[Calibration],
        robots: &[(Identifier, Mount, Footprint)],
        survey: Survey,
    ) -> Result<Self, RegistryError> {
        let markers = robots.iter().map(|&(identifier, mount, _)| (identifier, mount));
        let camera = |(index, calibration): (usize, &Calibration)| {
            let eye = Eye::new(index, calibration, survey)?;
            Some(Camera { eye, next_look: Instant(0), fault: None })
        };
        Ok(Self {
            localiser: Localiser::new(cameras, markers)?,
            eyes: cameras.iter().enumerate().map(camera).collect(),
            footprints: robots.iter().map(|&(_, mount, it)| (mount.robot, it)).collect(),
            localised: BTreeMap::new(),
        })
    }

    /// Processes a frame that arrived at `now` (server's clock). Depth images are processed at most
    /// five times a second. `told` are the poses that robots report themselves; they are used for
    /// robots that no camera sees.
    ///
    /// # Errors
    /// [`FrameError`], once for each fault of a camera's depth images. The observation returned with it
    /// still contains the robots in the picture.
    pub fn observe(
        &mut self,
        frame: &Frame,
        now: Instant,
        told: impl IntoIterator<Item = (RobotId, Pose)>,
    ) -> (Observation, Option<FrameError>) {
        let captured = frame.captured;
        let robots = self.localiser.observe(frame, now);
        for sighting in &robots {
            let last = self.localised.entry(sighting.robot).or_insert((captured, sighting.pose));
            if last.0 <= captured {
                *last = (captured, sighting.pose);
            }
        }
        let mut observation =
            Observation { camera: frame.camera, captured, robots, ..Observation::default() };
        let mut poses: BTreeMap<RobotId, Pose> = told.into_iter().collect();
        let recent = |&(_, &(moment, _)): &(&RobotId, &(Instant, Pose))| {
            moment.since(captured).max(captured.since(moment)) <= SIGHTING_HOLDS
        };
        poses
            .extend(self.localised.iter().filter(recent).map(|(&robot, &(_, pose))| (robot, pose)));
        let Some(Some(camera)) = self.eyes.get_mut(frame.camera) else {
            return (observation, None);
        };
        if frame.depth.is_none() || captured < camera.next_look {
            return (observation, None);
        }
        let bodies: Vec<(Footprint, Pose)> = poses
            .iter()
            .map(|(robot, &pose)| (self.footprints.get(robot).copied().unwrap_or_default(), pose))
            .collect();
        match camera.eye.look(frame, now, &bodies) {
            Ok(seen) => {
                camera.fault = None;
                camera.next_look = captured + LOOK_INTERVAL;
                observation.cells = seen.cells;
                observation.things = seen.things;
                (observation, None)
            }
            Err(error) => {
                let same = |last: &FrameError| {
                    core::mem::discriminant(last) == core::mem::discriminant(&error)
                };
                let is_known = camera.fault.replace(error).is_some_and(|last| same(&last));
                (observation, (!is_known).then_some(error))
            }
        }
    }

    /// The next problem with markers, and the capture time of the frame that shows it.
    pub fn poll_event(&mut self) -> Option<(Instant, SightingEvent)> {
        self.localiser.poll_event()
    }
}
