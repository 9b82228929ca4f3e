//! `ubimap watch`: the camera server on recorded frames of fixed cameras.
//!
//! The recording's clock drives the same deployment as in a simulation, but without ports.

use std::{fmt::Write, path::Path, time};

use ubimap_protocol::{
    frame::MAX_FRAME,
    message::{Obstacle, ObstacleClass, Posture},
    time::Instant,
    units::{Pose, RobotId},
};

use super::{
    Outcome, RunError, figures, floors, interruption, labels, markers, options::WatchOptions,
    progress::Progress, robots_file, terminal, volatility,
};
use crate::{
    camera::{Calibration, CamerasFile, Frame, FrameSource, MountedCamera, Picture, Sighting},
    deployment::{CameraStatus, Config, Deployment, Life, registry::Registry},
    files,
    grid::OccupancyGrid,
    mapping::ServedLayer,
    recording::{ExposureCounts, ExposureRule, LogError, Reading, RecordedFrames},
    report::{
        self, CameraSummary, Caption, ExposureSummary, HexDigest, Marker, MarkerKind, PassedEvent,
        SeenFloor, SeenMap, SeenRobot, SeenThing, WatchReport, posture_name,
    },
    server::Server,
};

/// Processes a recording.
///
/// # Errors
/// [`RunError`] if the recording or the file of robots is invalid.
pub fn run(options: &WatchOptions) -> Result<Outcome<WatchReport>, RunError> {
    let started = time::Instant::now();
    let may_lack_poses = options.cameras.is_some();
    let reading = Reading { may_lack_poses, depth_per_metre: options.unit.per_metre };
    let mut frames = RecordedFrames::open_with(&options.folders, reading)?;
    if let Some(path) = &options.cameras {
        frames = placed(frames, path)?;
    }
    let samples = RecordedFrames::open_with(&options.folders, reading)?;
    let floors = floors::check(samples, &mut frames, options.trust_floor)?;
    frames.notes().iter().for_each(|note| log::info!("{note}"));
    let registry = robots_file::find(options.robots.as_deref(), &options.folders)?;
    let config = Config {
        cameras: frames.cameras().to_vec(),
        registry: registry.clone(),
        keeps_sightings: true,
        obstacle_heights: options.obstacles,
        labels: labels::read(options.labels.as_deref())?,
        ..Config::new(options.resolution)
    };
    let mut deployment = Deployment::new(config, Life::default())?;
    let progress = Progress::new(frames.end());
    let mut exposed = Exposed::new(&mut frames, options.exposure)?;
    let end = play(&mut deployment, &mut exposed, |now| progress.at(now));
    let exposure = exposed.counts();
    drop(progress);
    if let Some(fault) = frames.take_fault() {
        return Err(fault.into());
    }

    let seen = Seen { deployment: &deployment, frames: &frames, end };
    let server = deployment.server();
    let (map, coverage) = (seen.grid(server.fused())?, seen.grid(server.coverage())?);
    let report = WatchReport {
        cameras: seen.cameras(&floors),
        robots: seen.robots(&registry),
        things: markers::followed(&deployment, end).into_iter().map(thing).collect(),
        events: events(server, &frames),
        camera_moves: figures::camera_moves(&deployment),
        exposure,
        map: seen.map(&map, &coverage),
        recorded_s: end.since(Instant(0)).micros() as f64 / 1e6,
        elapsed_s: started.elapsed().as_secs_f64(),
        ..WatchReport::default()
    };
    let folders = options.folders.iter().filter_map(|folder| folder.file_name()?.to_str());
    let caption = Caption {
        subject: folders.collect::<Vec<_>>().join(", "),
        seed: None,
        time_s: Some(report.recorded_s),
    };
    let markers = seen.markers();
    // Without robots and people, which would hide the coverage of the floor below them.
    let cameras = markers::cameras(deployment.calibrations());
    let picture = report::render_coverage(&map, &coverage, &cameras, &caption);
    let intervals = volatility::intervals(&deployment, &map, end);
    let changes = report::render_volatility(&map, &intervals, &caption);
    Ok(Outcome {
        report,
        markers,
        caption,
        pictures: vec![("coverage.png", picture), ("volatility.png", changes)],
        tables: vec![("robots.csv", seen.poses_csv())],
        map,
    })
}

/// Recorded frames whose depths are left out where the picture is badly exposed.
struct Exposed<'f> {
    frames: &'f mut RecordedFrames,
    rule: ExposureRule,
    counts: ExposureCounts,
}

impl<'f> Exposed<'f> {
    /// # Errors
    /// [`LogError::Exposure`] if a camera's pictures do not have the pixels of its depth images.
    fn new(frames: &'f mut RecordedFrames, rule: ExposureRule) -> Result<Self, RunError> {
        let is_apart =
            |camera: &Calibration| camera.depth.is_some() && camera.depth != camera.picture;
        if rule != ExposureRule::Any
            && let Some(camera) = frames.cameras().iter().position(is_apart)
        {
            let name = frames.names().get(camera).cloned().unwrap_or_default();
            return Err(LogError::Exposure { name }.into());
        }
        Ok(Self { frames, rule, counts: ExposureCounts::default() })
    }

    /// How many pixels were looked at and left out; `None` without a rule.
    fn counts(&self) -> Option<ExposureSummary> {
        (self.rule != ExposureRule::Any).then(|| self.counts.into())
    }
}

impl FrameSource for Exposed<'_> {
    fn cameras(&self) -> &[Calibration] {
        self.frames.cameras()
    }

    fn poll(&mut self, now: Instant) -> Option<Frame> {
        let mut frame = self.frames.poll(now)?;
        if let (Some(depth), Some(picture)) = (&mut frame.depth, &frame.picture) {
            self.counts += match picture {
                Picture::Grey(grey) => self.rule.apply(depth, grey),
                Picture::Colour(colour) => {
                    let grey = image::imageops::grayscale(colour);
                    self.rule.apply(depth, &grey)
                }
            };
        }
        Some(frame)
    }

    fn next_arrival(&self) -> Option<Instant> {
        self.frames.next_arrival()
    }
}

/// The frames of cameras at the poses of a file.
fn placed(mut frames: RecordedFrames, path: &Path) -> Result<RecordedFrames, RunError> {
    let refuse = |reason| LogError::Cameras { path: path.to_owned(), reason };
    let text = files::read_settings(path)
        .map_err(|error| LogError::Io { path: path.to_owned(), error })?;
    let file = CamerasFile::parse(&text).map_err(refuse)?;
    let poses = frames.names().iter().zip(frames.stated_poses()).map(|(name, stated)| {
        let pose = file.named(name).and_then(MountedCamera::pose).or(stated.copied());
        pose.ok_or_else(|| {
            refuse(format!("no camera is named {name:?}, and its folder has no pose"))
        })
    });
    let poses = poses.collect::<Result<Vec<_>, _>>()?;
    frames.place(&poses).map_err(|error| refuse(error.to_string()))?;
    Ok(frames)
}

/// Plays the frames of a recording to a deployment, by the recording's clock, until it ends or a
/// signal interrupts. Returns the arrival
/// time of the last frame.
pub fn play(
    deployment: &mut Deployment,
    frames: &mut dyn FrameSource,
    mut progress: impl FnMut(Instant),
) -> Instant {
    let mut now = Instant(0);
    while !interruption::is_requested()
        && let Some(next) = frames.next_arrival()
    {
        while let Some(due) = deployment.poll_timeout(now).filter(|due| *due < next) {
            now = now.max(due);
            deployment.timeout(now);
            drain(deployment, now);
        }
        now = now.max(next);
        while let Some(frame) = frames.poll(now) {
            deployment.frame(frame, now);
            drain(deployment, now);
        }
        progress(now);
    }
    now
}

/// Drains the outputs. There are no ports, so only events matter.
fn drain(deployment: &mut Deployment, now: Instant) {
    let mut frame = [0; MAX_FRAME];
    while deployment.poll_transmit(now, &mut frame).is_some() {}
    while let Some((moment, event)) = deployment.poll_event() {
        log::log!(event.level(), "{}: {event}", terminal::seconds(moment));
    }
}

/// The results of a recording.
struct Seen<'s> {
    deployment: &'s Deployment,
    frames: &'s RecordedFrames,
    /// Arrival time of the last frame.
    end: Instant,
}

impl Seen<'_> {
    fn grid(&self, layer: &ServedLayer) -> Result<OccupancyGrid, RunError> {
        let tiles = layer.tiles().map(|(id, _, tile)| (id, tile));
        Ok(OccupancyGrid::from_tiles(tiles, self.deployment.resolution())?)
    }

    fn map(&self, map: &OccupancyGrid, coverage: &OccupancyGrid) -> SeenMap {
        SeenMap::new(map, coverage, HexDigest(self.deployment.server().fused().digest().0))
    }

    /// The figures of each camera. Warns of cameras that have contributed nothing.
    fn cameras(&self, floors: &[Option<SeenFloor>]) -> Vec<CameraSummary> {
        let (status, frames) = (self.deployment.status(), self.frames);
        let cameras = frames.cameras().iter().zip(frames.names()).zip(frames.counts());
        let summaries = cameras.enumerate().map(|(camera, ((calibration, name), counts))| {
            let (frames, lost) = counts;
            let CameraStatus { looks, digest, .. } =
                status.cameras.get(&camera).copied().unwrap_or_default();
            if calibration.depth.is_some() && looks == 0 {
                log::warn!(
                    "{name} has mapped no cell: it needs more than 15 depth images, at least 0.3 s \
                     apart, to learn the background; otherwise check its pose (z up, floor at 0)"
                );
            }
            let floor = floors.get(camera).copied().flatten();
            let digest = HexDigest(digest.into());
            CameraSummary { name: name.clone(), frames, lost, looks, digest, floor }
        });
        summaries.collect()
    }

    /// The sightings of a robot with their capture times, in order.
    fn sightings_of(&self, robot: RobotId) -> Vec<(Instant, Sighting)> {
        let all = self.deployment.sightings().iter();
        let mut found: Vec<_> = all.filter(|(_, it)| it.robot == robot).copied().collect();
        // Frames may arrive out of order.
        found.sort_by_key(|(captured, _)| *captured);
        found
    }

    /// The robots that the cameras localised, with their sightings.
    fn localised(&self) -> Vec<(RobotId, Vec<(Instant, Sighting)>)> {
        let all = self.deployment.sightings().iter();
        let mut robots: Vec<RobotId> = all.map(|(_, it)| it.robot).collect();
        robots.sort_unstable();
        robots.dedup();
        robots.into_iter().map(|robot| (robot, self.sightings_of(robot))).collect()
    }

    /// The figures of all registered robots.
    fn robots(&self, registry: &Registry) -> Vec<SeenRobot> {
        let mut robots: Vec<RobotId> = registry.footprints().map(|(robot, _)| robot).collect();
        robots.sort_unstable();
        let summary = |robot| {
            let seen = self.sightings_of(robot);
            let last = seen.last();
            SeenRobot {
                id: robot.0,
                sightings: seen.len() as u64,
                last_s: last.map(|(captured, _)| self.frames.clock_s(*captured)),
                pose: last.map(|(_, sighting)| metres_and_degrees(sighting.pose)),
            }
        };
        robots.into_iter().map(summary).collect()
    }

    /// The robots at their last sightings with their paths, the people at the end, and the cameras.
    fn markers(&self) -> Vec<Marker> {
        let robots = self.localised().into_iter().filter_map(|(robot, seen)| {
            let &(_, Sighting { pose, .. }) = seen.last()?;
            let [x, y, _] = metres_and_degrees(pose);
            Some(Marker {
                radius_m: markers::radius_m(self.deployment, robot),
                label: robot.0.to_string(),
                path: seen.iter().map(|(_, it)| [it.pose.x.metres(), it.pose.y.metres()]).collect(),
                ..Marker::new(MarkerKind::Robot, [x, y], pose.heading.radians())
            })
        });
        let people = markers::people(self.deployment, self.end);
        robots.chain(people).chain(markers::cameras(self.deployment.calibrations())).collect()
    }

    /// All sighted poses as CSV, with times of the recording's clock.
    fn poses_csv(&self) -> String {
        let mut text = "time_s,robot,x_m,y_m,heading_deg,sd_x_m,sd_y_m,sd_heading_deg\n".to_owned();
        for (robot, seen) in self.localised() {
            for (captured, Sighting { pose, certainty, .. }) in seen {
                let [x, y, heading] = metres_and_degrees(pose);
                let [sd_x, sd_y] = [certainty.x, certainty.y].map(|it| f64::from(it) / 1000.0);
                let sd_heading = f64::from(certainty.heading) * 360.0 / 65536.0;
                let time = self.frames.clock_s(captured);
                // Writing to a string can't fail.
                let _ = writeln!(
                    text,
                    "{time:.6},{},{x:.3},{y:.3},{heading:.2},{sd_x:.3},{sd_y:.3},{sd_heading:.2}",
                    robot.0
                );
            }
        }
        text
    }
}

fn metres_and_degrees(pose: Pose) -> [f64; 3] {
    [pose.x.metres(), pose.y.metres(), pose.heading.degrees()]
}

fn thing((obstacle, posture): (Obstacle, Posture)) -> SeenThing {
    let metres = |millimetres: i16| f64::from(millimetres) / 1000.0;
    SeenThing {
        class: match obstacle.class {
            ObstacleClass::Person => "person",
            ObstacleClass::Movable => "movable",
            ObstacleClass::Fixed => "fixed",
        },
        posture: posture_name(posture),
        position_m: [obstacle.x.metres(), obstacle.y.metres()],
        velocity_m_s: [obstacle.velocity_x, obstacle.velocity_y].map(metres),
        radius_m: f64::from(obstacle.radius) / 1000.0,
    }
}

fn events(server: &Server, frames: &RecordedFrames) -> Vec<PassedEvent> {
    let event =
        |what: String, count, last| PassedEvent { what, count, last_s: frames.clock_s(last) };
    let of_robots = server.sighting_events().iter();
    let of_robots = of_robots.map(|(what, count, last)| event(what.to_string(), count, last));
    let of_people = server.person_events().iter();
    of_robots
        .chain(of_people.map(|(what, count, last)| event(what.to_string(), count, last)))
        .collect()
}
