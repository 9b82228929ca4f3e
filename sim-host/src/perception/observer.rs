//! Turns frames into observations: localises the robots, and perceives cells and objects.

use std::collections::{BTreeMap, VecDeque};

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
    steadiness::{Body, Change, Standing, Steadiness},
};
use crate::{
    camera::{Calibration, Frame, Observation},
    timing::SIGHTING_HOLDS,
};

/// Minimum interval between processed depth images of one camera: people walk 0.25 m in this time.
const LOOK_INTERVAL: Duration = Duration::from_millis(190);

/// Time after which cameras that accuse each other are reported.
const DISPUTE_LASTS: Duration = Duration::from_millis(1_500);

/// Perception of all cameras.
#[derive(Debug)]
pub struct Observer {
    localiser: Localiser,
    eyes: Vec<Option<Camera>>,
    /// The footprint of each robot, and its height in metres: that of its marker.
    sizes: BTreeMap<RobotId, (Footprint, f64)>,
    /// The time and pose of each robot's last localisation.
    localised: BTreeMap<RobotId, (Instant, Pose)>,
    changes: VecDeque<(Instant, usize, Change)>,
    /// When several cameras began to accuse each other, and whether that was reported.
    disputed: Option<(Instant, bool)>,
}

#[derive(Debug)]
struct Camera {
    eye: Eye,
    calibration: Calibration,
    steadiness: Steadiness,
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
            let lens = calibration.depth.as_ref()?;
            let steadiness =
                Steadiness::new(lens.intrinsics(), calibration.depth_noise, *lens.pose());
            let (calibration, next_look) = (*calibration, Instant(0));
            Some(Camera { eye, calibration, steadiness, next_look, fault: None })
        };
        Ok(Self {
            localiser: Localiser::new(cameras, markers)?,
            eyes: cameras.iter().enumerate().map(camera).collect(),
            sizes: robots
                .iter()
                .map(|&(_, mount, it)| (mount.robot, (it, mount.height_m)))
                .collect(),
            localised: BTreeMap::new(),
            changes: VecDeque::new(),
            disputed: None,
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
        let mut poses: BTreeMap<RobotId, Pose> = told.into_iter().collect();
        poses.extend(self.localised(captured));
        let is_trusted = self.watch(frame, now, &self.bodies(&poses));
        let robots = self.localiser.observe(frame, now);
        for sighting in &robots {
            let last = self.localised.entry(sighting.robot).or_insert((captured, sighting.pose));
            if last.0 <= captured {
                *last = (captured, sighting.pose);
            }
        }
        if let Some(Some(camera)) = self.eyes.get_mut(frame.camera) {
            let (seen, calibration) = (self.localiser.witnesses(), camera.calibration);
            camera.steadiness.hear(&calibration, seen, captured);
        }
        let mut observation =
            Observation { camera: frame.camera, captured, robots, ..Observation::default() };
        poses.extend(self.localised(captured));
        let bodies = self.bodies(&poses);
        let Some(Some(camera)) = self.eyes.get_mut(frame.camera) else {
            return (observation, None);
        };
        if !is_trusted || frame.depth.is_none() || captured < camera.next_look {
            return (observation, None);
        }
        let bodies: Vec<(Footprint, Pose)> =
            bodies.iter().map(|body| (body.footprint, body.pose)).collect();
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

    /// The robots that cameras see at a moment.
    fn localised(&self, moment: Instant) -> impl Iterator<Item = (RobotId, Pose)> {
        let recent = move |&(_, &(seen, _)): &(&RobotId, &(Instant, Pose))| {
            seen.since(moment).max(moment.since(seen)) <= SIGHTING_HOLDS
        };
        self.localised.iter().filter(recent).map(|(&robot, &(_, pose))| (robot, pose))
    }

    fn bodies(&self, poses: &BTreeMap<RobotId, Pose>) -> Vec<Body> {
        let body = |(robot, &pose)| {
            let (footprint, height_m) = self.sizes.get(robot).copied().unwrap_or_default();
            Body { footprint, pose, height_m }
        };
        poses.iter().map(body).collect()
    }

    /// Whether the camera of a frame stands where it should, as far as is known. `robots` are about in view.
    fn watch(&mut self, frame: &Frame, now: Instant, robots: &[Body]) -> bool {
        let accused = self.eyes.iter().enumerate().filter(|(_, camera)| {
            camera.as_ref().is_some_and(|camera| camera.steadiness.is_accused())
        });
        let accused: Vec<usize> = accused.map(|(index, _)| index).collect();
        self.hear_dispute(frame.captured, &accused);
        let Some(Some(camera)) = self.eyes.get_mut(frame.camera) else { return true };
        let before = camera.steadiness.standing();
        if frame.captured >= camera.next_look
            && let Ok(depths) = camera.eye.check(frame, now)
        {
            let is_accused = accused == [frame.camera];
            let change = camera.steadiness.look(depths, frame.captured, robots, is_accused);
            if let Some(change) = change {
                camera.change(&change);
                self.localiser.stand(frame.camera, camera.calibration.picture);
                self.changes.push_back((frame.captured, frame.camera, change));
            }
            if camera.steadiness.standing() != Standing::Steady {
                camera.next_look = frame.captured + LOOK_INTERVAL;
            }
        }
        let standing = camera.steadiness.standing();
        if standing != before {
            self.localiser.leave_out(frame.camera, standing != Standing::Steady);
        }
        standing == Standing::Steady
    }

    /// Reports cameras that accuse each other for some time.
    fn hear_dispute(&mut self, captured: Instant, accused: &[usize]) {
        if accused.len() < 2 {
            self.disputed = None;
            return;
        }
        let (since, is_told) = self.disputed.get_or_insert((captured, false));
        if !*is_told && captured.since(*since) >= DISPUTE_LASTS {
            *is_told = true;
            self.changes.extend(accused.iter().map(|&camera| (captured, camera, Change::Disputed)));
        }
    }

    /// The next change of a camera's pose: the capture time of the frame that shows it, and the camera.
    pub fn poll_change(&mut self) -> Option<(Instant, usize, Change)> {
        self.changes.pop_front()
    }

    /// Whether a camera stands where it should, and its calibration at its present pose. `None` without a
    /// depth sensor.
    pub fn standing(&self, camera: usize) -> Option<(Standing, &Calibration)> {
        let camera = self.eyes.get(camera)?.as_ref()?;
        Some((camera.steadiness.standing(), &camera.calibration))
    }

    /// The next problem with markers, and the capture time of the frame that shows it.
    pub fn poll_event(&mut self) -> Option<(Instant, SightingEvent)> {
        self.localiser.poll_event()
    }
}

impl Camera {
    /// Moves the camera to its new pose.
    fn change(&mut self, change: &Change) {
        let (pose, relearns) = match change {
            Change::Knocked { .. } | Change::Disputed => return,
            Change::Returned(pose) => (pose, true),
            Change::Drifted(pose) => (pose, false),
        };
        // A pose that was found by a view is finite.
        if let Ok(calibration) = self.calibration.at(*pose) {
            self.calibration = calibration;
            self.eye.stand(&self.calibration, relearns);
        }
    }
}
