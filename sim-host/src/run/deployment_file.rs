//! The file of a deployment: what `ubimap serve DEPLOYMENT.toml` serves.
//!
//! [`EXAMPLE`], which `ubimap init` writes, shows all keys. Its `[[robots]]` are those of `robots.toml`
//! ([`registry`](crate::deployment::registry)), and its `[[cameras]]` have the poses of `cameras.toml`
//! ([`CamerasFile`]), so that what `place` and `calibrate` write can be copied
//! or named (`poses`). Paths are relative to the file.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
};

use nalgebra::{Isometry3, Translation3};
use serde::Deserialize;
use ubimap_protocol::{time::Duration, units::Millimetres};

use super::{RunError, options};
use crate::{
    camera::{Calibration, CamerasFile, Lens, MountedCamera},
    channel::address::Address,
    deployment::registry::{RegisteredRobot, Registry},
    files,
    grid::{self, Label, OccupancyGrid, read_labels},
    recording::{IntrinsicsFile, Reading, RecordedFrames},
    server::coordination::{Area, DrivableFloor},
};

/// A commented deployment, which `ubimap init` writes.
pub const EXAMPLE: &str = include_str!("../../doc/deployment.toml");

/// A deployment as its file states it.
#[derive(Debug)]
pub struct DeploymentFile {
    /// The file.
    pub path: PathBuf,
    /// The side of the map's cells.
    pub resolution: Millimetres,
    /// Heights between which things block robots.
    pub obstacles: Option<[Millimetres; 2]>,
    /// A floor plan.
    pub plan: Option<OccupancyGrid>,
    /// The floor that robots may use: an area, if one is stated, without the walls of the plan.
    pub floor: Option<DrivableFloor>,
    /// Where things of a class stand.
    pub labels: Vec<Label>,
    /// The file that the map is stored in.
    pub store: Option<PathBuf>,
    /// The folder for the map and the pictures.
    pub out: PathBuf,
    /// Interval at which they are written.
    pub interval: Duration,
    /// The folder with the robots' keys; without it the ports are open.
    pub keys: Option<PathBuf>,
    /// Where robots are.
    pub ports: Vec<Address>,
    /// The robots.
    pub registry: Registry,
    /// The cameras.
    pub cameras: Vec<DeployedCamera>,
    /// How recorded frames are played.
    pub playback: Playback,
}

/// How recorded frames are played.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Playback {
    /// The speed of the server's clock as a multiple of real time.
    pub speed: f64,
    /// Whether perception looks at every frame, late if it can't keep up. Otherwise newer frames replace those
    /// that wait, as those of live cameras do.
    pub every_frame: bool,
}

impl Default for Playback {
    fn default() -> Self {
        Self { speed: 1.0, every_frame: false }
    }
}

/// A camera of a deployment.
#[derive(Clone, Debug)]
pub struct DeployedCamera {
    /// Its name.
    pub name: String,
    /// Where its frames come from.
    pub source: CameraSource,
    /// Its intrinsics and pose. Without a pose it is shown and not used.
    pub calibration: Calibration,
    /// Whether its pose is stated.
    pub is_placed: bool,
}

/// Where a camera's frames come from.
#[derive(Clone, Debug, PartialEq)]
pub enum CameraSource {
    /// A folder of recorded frames.
    Folder(PathBuf),
    /// A Unix socket at which a sender connects.
    UnixStream(PathBuf),
    /// A TCP socket at which a sender connects.
    TcpStream(std::net::SocketAddr),
    /// Video4Linux devices, at least one of the two.
    V4l2 {
        /// The device of the depth images.
        depth: Option<PathBuf>,
        /// The device of the pictures.
        picture: Option<PathBuf>,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Keys {
    #[serde(default = "usual_resolution_m")]
    resolution_m: f64,
    obstacles_m: Option<[f64; 2]>,
    plan: Option<PathBuf>,
    floor: Option<StatedArea>,
    labels: Option<PathBuf>,
    store: Option<PathBuf>,
    #[serde(default = "usual_out")]
    out: PathBuf,
    #[serde(default = "usual_interval_s")]
    every_s: f64,
    keys: Option<PathBuf>,
    #[serde(default)]
    ports: Vec<String>,
    poses: Option<PathBuf>,
    #[serde(default)]
    cameras: Vec<toml::Table>,
    #[serde(default)]
    robots: Vec<RegisteredRobot>,
    #[serde(default)]
    playback: Playback,
}

/// The floor that robots may use, as the file states it.
#[derive(Deserialize)]
#[serde(
    untagged,
    expecting = "give a ROS map, as in \"floor.yaml\", or the corners of a polygon in metres, as in \
                               [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]"
)]
enum StatedArea {
    Map(PathBuf),
    Corners(Vec<[f64; 2]>),
}

fn usual_interval_s() -> f64 {
    60.0
}

fn usual_resolution_m() -> f64 {
    0.05
}

fn usual_out() -> PathBuf {
    "ubimap-out".into()
}

/// The keys of a camera that are not of its pose.
#[derive(Deserialize)]
struct CameraKeys {
    #[serde(default)]
    name: String,
    source: String,
    picture_source: Option<String>,
    depth: Option<IntrinsicsFile>,
    picture: Option<IntrinsicsFile>,
    #[serde(default)]
    picture_offset_m: [f64; 3],
}

/// All keys of a camera; the last line are those that `place` writes for scenarios.
const CAMERA_KEYS: [&str; 17] = [
    "name",
    "source",
    "picture_source",
    "depth",
    "picture",
    "picture_offset_m",
    "position_m",
    "look_at_m",
    "heading_deg",
    "tilt_deg",
    "roll_deg",
    "horizontal_fov_deg",
    "vertical_fov_deg",
    "range_m",
    "rate_hz",
    "latency_ms",
    "cells_rate_hz",
];

impl DeploymentFile {
    /// Reads a file.
    ///
    /// # Errors
    /// [`RunError::Deployment`], which names the file, and the line, camera or robot.
    pub fn read(path: &Path) -> Result<Self, RunError> {
        let refuse = |reason: String| RunError::Deployment { path: path.to_owned(), reason };
        let text = files::read_settings(path).map_err(|error| refuse(error.to_string()))?;
        let beside = path.parent().unwrap_or(Path::new(""));
        Self::parse(path, beside, &text).map_err(refuse)
    }

    fn parse(path: &Path, beside: &Path, text: &str) -> Result<Self, String> {
        let keys: Keys = toml::from_str(text).map_err(|error| files::toml_fault(&error, text))?;
        let poses = match &keys.poses {
            Some(poses) => {
                let poses = beside.join(poses);
                let text = files::read_settings(&poses).map_err(|error| error.to_string());
                let file = text.and_then(|text| CamerasFile::parse(&text));
                file.map_err(|reason| format!("poses: {}: {reason}", poses.display()))?
            }
            None => CamerasFile::default(),
        };
        let mut names = BTreeSet::new();
        let cameras = keys.cameras.into_iter().enumerate().map(|(index, keys)| {
            let name = keys.get("name").and_then(|name| name.as_str()).unwrap_or_default();
            let named = match name {
                "" => format!("cameras[{index}]"),
                name => format!("camera {name}"),
            };
            let camera = camera(keys, index, beside, &poses);
            let camera = camera.map_err(|reason| format!("{named}: {reason}"))?;
            match names.insert(camera.name.clone()) {
                true => Ok(camera),
                false => Err(format!("two cameras are named {:?}", camera.name)),
            }
        });
        let cameras = cameras.collect::<Result<Vec<_>, String>>()?;
        let of_robots = keys.robots.iter().filter_map(|robot| robot.port.clone());
        let mut ports = Vec::new();
        for port in keys.ports.iter().cloned().chain(of_robots) {
            let port: Address = port.parse().map_err(|error| format!("ports: {error}"))?;
            let port = match port {
                Address::Serial(path) => Address::Serial(beside.join(path)),
                socket => socket,
            };
            if !ports.contains(&port) {
                ports.push(port);
            }
        }
        let registry = Registry { robots: keys.robots }.checked().map_err(|it| it.to_string())?;
        let resolution = options::resolution(&keys.resolution_m.to_string())
            .map_err(|error| format!("resolution_m: {error}"))?;
        let heights = |[low, high]: [f64; 2]| {
            options::heights(&format!("{low},{high}"))
                .map_err(|error| format!("obstacles_m: {error}"))
        };
        let plan = keys.plan.map(|plan| grid::read_map(&beside.join(plan)));
        let plan = plan.transpose().map_err(|error| format!("plan: {error}"))?;
        let area = keys.floor.map(|area| match area {
            StatedArea::Map(map) => grid::read_map(&beside.join(map)).map(Area::FreeCells),
            StatedArea::Corners(corners) => Ok(Area::Polygon(corners)),
        });
        let area = area.transpose().map_err(|error| format!("floor: {error}"))?;
        let floor = (area.is_some() || plan.is_some())
            .then(|| DrivableFloor::new(resolution, area.as_ref(), plan.as_ref()))
            .transpose()
            .map_err(|error| format!("floor: {error}"))?;
        let labels = keys.labels.map(|path| {
            let path = beside.join(path);
            read_labels(&path).map_err(|reason| format!("labels: {}: {reason}", path.display()))
        });
        let interval = options::seconds(&keys.every_s.to_string())
            .map_err(|error| format!("every_s: {error}"))?;
        Ok(Self {
            path: path.to_owned(),
            resolution,
            plan,
            floor,
            interval,
            labels: labels.transpose()?.unwrap_or_default(),
            obstacles: keys.obstacles_m.map(heights).transpose()?,
            store: keys.store.map(|store| beside.join(store)),
            out: beside.join(keys.out),
            keys: keys.keys.map(|keys| beside.join(keys)),
            playback: playback(keys.playback, &cameras, &ports)?,
            ports,
            registry,
            cameras,
        })
    }
}

fn camera(
    keys: toml::Table,
    index: usize,
    beside: &Path,
    poses: &CamerasFile,
) -> Result<DeployedCamera, String> {
    if let Some(key) = keys.keys().find(|key| !CAMERA_KEYS.contains(&key.as_str())) {
        return Err(format!("unknown key `{key}`; the keys are {}", CAMERA_KEYS.join(", ")));
    }
    let one_line = |error: toml::de::Error| error.message().lines().collect::<Vec<_>>().join(" ");
    let stated: CameraKeys = keys.clone().try_into().map_err(one_line)?;
    let name = match stated.name.as_str() {
        "" => format!("camera-{index:02}"),
        name => name.to_owned(),
    };
    let own = match keys.contains_key("position_m") {
        true => {
            let camera: MountedCamera = keys.try_into().map_err(one_line)?;
            let needs = "position_m needs either look_at_m, or heading_deg and tilt_deg beside it";
            Some(camera.pose().ok_or(needs)?)
        }
        false => None,
    };
    let pose = poses.named(&name).and_then(MountedCamera::pose).or(own);
    let source = source(&stated, beside)?;
    let (calibration, recorded) = match &source {
        CameraSource::Folder(folder) => recorded(folder)?,
        _ => {
            let offset = Isometry3::from_parts(
                Translation3::from(stated.picture_offset_m),
                Default::default(),
            );
            (calibrated(stated.depth.as_ref(), stated.picture.as_ref(), offset)?, None)
        }
    };
    let pose = pose.or(recorded);
    if pose.is_some_and(|pose| pose.translation.z <= 0.0) {
        return Err("its height above the floor must be above 0".into());
    }
    let calibration = match pose {
        Some(pose) => calibration.at(pose).map_err(|error| error.to_string())?,
        None => calibration,
    };
    Ok(DeployedCamera { name, source, calibration, is_placed: pose.is_some() })
}

/// Checks that nothing but recorded frames follows a clock that is not of real time.
fn playback(
    playback: Playback,
    cameras: &[DeployedCamera],
    ports: &[Address],
) -> Result<Playback, String> {
    if !(0.01..=1_000.0).contains(&playback.speed) {
        return Err(format!("playback: a speed of {} must be from 0.01 to 1000", playback.speed));
    }
    let live = cameras.iter().find(|camera| !matches!(camera.source, CameraSource::Folder(_)));
    let live = live.map(|camera| format!("camera {}", camera.name));
    match live.or(ports.first().map(Address::to_string)) {
        Some(live) if playback.speed != 1.0 => Err(format!(
            "playback: {live} lives in real time; a speed other than 1 is for recorded frames alone"
        )),
        _ => Ok(playback),
    }
}

fn source(keys: &CameraKeys, beside: &Path) -> Result<CameraSource, String> {
    let text = &keys.source;
    let (kind, at) = text.split_once(':').unwrap_or_default();
    if keys.picture_source.is_some() && kind != "v4l2" {
        return Err(
            "picture_source: only a v4l2 source has one; other frames have both images".into()
        );
    }
    match kind {
        "folder" => Ok(CameraSource::Folder(beside.join(at))),
        "stream" => Ok(match format!("tcp:{at}").parse() {
            Ok(Address::Tcp(address)) => CameraSource::TcpStream(address),
            _ => CameraSource::UnixStream(beside.join(at)),
        }),
        "v4l2" => devices(keys, at, beside),
        _ => Err(format!(
            "source: {text:?} is none; give folder:DIR, stream:SOCKET (a path), stream:HOST:PORT or \
             v4l2:DEVICE"
        )),
    }
}

/// The Video4Linux devices of a camera.
fn devices(keys: &CameraKeys, source: &str, beside: &Path) -> Result<CameraSource, String> {
    let device = |path: &str| match path {
        "" => Err("source: v4l2 needs a device, such as v4l2:/dev/video0".to_owned()),
        path if path.contains('\0') => Err("source: a device has no NUL in its name".to_owned()),
        path => Ok(beside.join(path)),
    };
    let source = device(source)?;
    let other = keys.picture_source.as_deref().map(|text| match text.split_once(':') {
        Some(("v4l2", path)) => device(path),
        _ => Err(format!("picture_source: {text:?} is none; give v4l2:DEVICE")),
    });
    let (depth, picture) = match (&keys.depth, &keys.picture, other.transpose()?) {
        (Some(_), Some(_), Some(other)) => (Some(source), Some(other)),
        (Some(_), Some(_), None) => {
            return Err(
                "picture: needs the device of the pictures, picture_source = \"v4l2:DEVICE\""
                    .into(),
            );
        }
        (_, _, Some(_)) => {
            return Err(
                "picture_source: needs the intrinsics of both images, depth and picture".into()
            );
        }
        (None, Some(_), None) => (None, Some(source)),
        (_, None, None) => (Some(source), None),
    };
    Ok(CameraSource::V4l2 { depth, picture })
}

/// The calibration of a recorded camera, and its pose, if the folder states one.
fn recorded(folder: &Path) -> Result<(Calibration, Option<Isometry3<f64>>), String> {
    let frames = RecordedFrames::open_with(&[folder.to_owned()], Reading::UNPLACED)
        .map_err(|error| error.to_string())?;
    match (
        crate::camera::FrameSource::cameras(&frames),
        &frames.stated_poses().collect::<Vec<_>>()[..],
    ) {
        ([calibration], [pose]) => Ok((*calibration, pose.copied())),
        (cameras, _) => Err(format!(
            "{}: holds {} cameras; name the folder of one fixed camera",
            folder.display(),
            cameras.len()
        )),
    }
}

/// The calibration of a camera whose depth sensor is at the origin.
fn calibrated(
    depth: Option<&IntrinsicsFile>,
    picture: Option<&IntrinsicsFile>,
    offset: Isometry3<f64>,
) -> Result<Calibration, String> {
    if depth.is_none() && picture.is_none() {
        return Err(
            "needs its intrinsics: depth = { width, height, fx, fy, cx, cy }, and picture \
                    if it has one"
                .into(),
        );
    }
    let lens = |which: &str, file: Option<&IntrinsicsFile>, pose| {
        let lens = file.map(|file| {
            let pinhole = file.pinhole()?;
            Lens::new(pinhole, pose).map_err(|error| error.to_string())
        });
        lens.transpose().map_err(|reason| format!("{which}: {reason}"))
    };
    let noise = depth.map_or(Ok(Default::default()), IntrinsicsFile::noise);
    Ok(Calibration {
        depth: lens("depth", depth, Isometry3::identity())?,
        depth_noise: noise.map_err(|error| error.to_string())?,
        picture: lens("picture", picture, offset)?,
    })
}

#[cfg(test)]
mod tests;
