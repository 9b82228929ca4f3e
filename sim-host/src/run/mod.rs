//! The drivers of a deployment: one file per `ubimap` command, the options, and the fleet of
//! simulated robots. A driver supplies the clock, the sources and the channels; all decisions are
//! made in the [`deployment`](crate::deployment).

pub mod backup;
pub mod bench;
mod body;
pub mod calibrate;
pub mod calibration_drive;
pub mod compare;
pub mod conformance;
pub mod control;
mod convergence;
pub mod decode;
pub mod deployment_file;
mod driving;
mod figures;
pub mod fleet;
mod floors;
mod graph_map;
pub mod grey_robot;
pub mod heap;
pub mod init;
pub mod interruption;
pub mod keeper;
pub mod keys;
mod labels;
mod map_age;
pub mod marker_sheet;
mod markers;
pub mod member;
mod network;
mod onboard;
pub mod options;
pub mod outside;
pub mod place;
mod pointset;
mod progress;
pub mod provision;
pub mod record;
pub mod replay;
pub mod reproduce;
#[cfg(target_os = "linux")]
pub mod rig;
mod rising;
pub mod robot;
mod robot_clock;
mod robots_file;
pub mod room_stage;
pub mod scale;
pub mod scan_log;
pub mod scoring;
pub mod serve;
pub mod simulate;
mod stage;
pub mod terminal;
mod time_lapse;
mod vision;
mod volatility;
pub mod watch;

use std::path::PathBuf;

use image::RgbImage;
use serde::Serialize;
use ubimap_agent::ConfigError;

use self::keys::KeysError;
use crate::{
    channel::wire::WireError,
    grid::{self, GridError, MapError, OccupancyGrid},
    perception::robots::RegistryError,
    recording::{FramesError, LogError},
    report::{self, Caption, Marker, OutputError, OutputFolder, Report},
    store::StoreError,
    world::ScenarioError,
};

/// The results of a run that draws a map.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome<R = Report> {
    /// The figures.
    pub report: R,
    /// The fused map.
    pub map: OccupancyGrid,
    /// The robots, people and cameras after the last frame or scan was processed.
    pub markers: Vec<Marker>,
    /// Subject, seed and time of the pictures.
    pub caption: Caption,
    /// Further pictures, each with its file name.
    pub pictures: Vec<(&'static str, RgbImage)>,
    /// Tables as text, each with its file name.
    pub tables: Vec<(&'static str, String)>,
}

impl<R: Serialize> Outcome<R> {
    /// Writes `map.pgm`, `map.yaml`, `map.png`, `report.json`, the other pictures and the tables:
    /// either all of them or none.
    pub fn write(&self, mut folder: OutputFolder) -> Result<(), RunError> {
        folder.add("map.pgm", &grid::pgm(&self.map))?;
        folder.add("map.yaml", grid::yaml(&self.map, "map.pgm").as_bytes())?;
        folder.add(
            "map.png",
            &report::png(&report::render(&self.map, &self.markers, &self.caption))?,
        )?;
        for (name, picture) in &self.pictures {
            folder.add(name, &report::png(picture)?)?;
        }
        for (name, table) in &self.tables {
            folder.add(name, table.as_bytes())?;
        }
        folder.add("report.json", report::json_pretty(&self.report).as_bytes())?;
        Ok(folder.finish()?)
    }
}

/// Why a run could not start or finish. Each message is one line.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A log can't be read or written.
    #[error(transparent)]
    Log(#[from] LogError),
    /// Recorded frames can't be read.
    #[error(transparent)]
    Frames(#[from] FramesError),
    /// A file of robots can't be used.
    #[error("{path}: {reason}", path = path.display())]
    Robots {
        /// The file.
        path: PathBuf,
        /// The reason, in one line.
        reason: String,
    },
    /// A file of labels can't be used.
    #[error("{path}: {reason}", path = path.display())]
    Labels {
        /// The file.
        path: PathBuf,
        /// The reason, in one line.
        reason: String,
    },
    /// A deployment can't be served.
    #[error("{path}: {reason}", path = path.display())]
    Deployment {
        /// Its file.
        path: PathBuf,
        /// The reason, in one line.
        reason: String,
    },
    /// A running server can't be asked, or refuses.
    #[error("{path}: {reason}", path = path.display())]
    Control {
        /// Its socket.
        path: PathBuf,
        /// The reason, in one line.
        reason: String,
    },
    /// A robot at a port does not do what is asked.
    #[error("{port}: {reason}")]
    Bench {
        /// The port.
        port: String,
        /// The reason, in one line.
        reason: String,
    },
    /// A parameter can't be asked for as typed.
    #[error("{reason}")]
    Parameter {
        /// What is expected, in one line.
        reason: String,
    },
    /// A map can't be read.
    #[error(transparent)]
    Map(#[from] MapError),
    /// The fused map can't become a grid.
    #[error(transparent)]
    Grid(#[from] GridError),
    /// The results can't be written.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// The report can't be printed.
    #[error("standard output: can't write the report: {0}")]
    Print(std::io::Error),
    /// The map can't be stored.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A life of the server can't begin.
    #[error("the operating system gave no random number for the server's epoch: {0}")]
    Randomness(getrandom::Error),
    /// The picture can't be encoded.
    #[error("map.png: {0}")]
    Picture(#[from] image::ImageError),
    /// A scenario can't be used.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// A serial port can't be opened.
    #[error(transparent)]
    Port(#[from] WireError),
    /// Markers can't be printed as asked.
    #[error("{0}")]
    Markers(String),
    /// There is no check with this number.
    #[error("--only {number}: there is no such check; --list shows 1 to {checks}")]
    NoCheck {
        /// The number.
        number: usize,
        /// Number of checks.
        checks: usize,
    },
    /// A capture can't be read.
    #[error("{name}: {reason}")]
    Capture {
        /// The file, or the text in its place.
        name: String,
        /// The reason, in one line.
        reason: String,
    },
    /// A socket without seals.
    #[error(
        "{address}: whoever reaches a socket could pose as a robot; give --keys DIR, or --open to allow that on a bench"
    )]
    Unsealed {
        /// The socket.
        address: String,
    },
    /// The keys can't be used.
    #[error(transparent)]
    Keys(#[from] KeysError),
    /// An image can't be provisioned.
    #[error(transparent)]
    Provision(#[from] provision::ProvisionError),
    /// The number of poses is neither zero, one, nor the number of ports.
    #[error("--pose: {poses} poses for {ports} ports; give one for all ports, or one per port")]
    Poses {
        /// Number of poses given.
        poses: usize,
        /// Number of ports given.
        ports: usize,
    },
    /// No robot can be configured with these options.
    #[error("no robot can be configured with these options: {}", explain(.0))]
    Robot(ConfigError),
    /// Two robots carry the same marker, or a marker is invalid.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// More robots were requested than the scenario has.
    #[error("--robots {asked}: the scenario has only {there}")]
    TooManyRobots {
        /// Number of robots requested.
        asked: usize,
        /// Number of robots in the scenario.
        there: usize,
    },
    /// A camera is to be knocked that the scenario does not have.
    #[error("--knock: there is no camera {camera}; the scenario has {there}, numbered from 0")]
    NoSuchCamera {
        /// The camera's index.
        camera: usize,
        /// Number of cameras in the scenario.
        there: usize,
    },
    /// A robot outside needs a scenario with one robot.
    #[error("--outside, --in-step: the scenario has {there} robots; choose one with --robots 1")]
    OneRobot {
        /// Number of robots in the scenario.
        there: usize,
    },
    /// A robot outside needs a scenario with cameras.
    #[error(
        "--outside, --in-step: the scenario has no fixed cameras, so nobody can tell the robot where it is; add [[cameras]] to it, or choose another"
    )]
    NoCameraForOutside,
    /// A scale table can't be read or fitted.
    #[error("{name}: {reason}")]
    Scale {
        /// The table's file.
        name: String,
        /// The reason, in one line.
        reason: String,
    },
    /// A signal ended a series of runs.
    #[error("interrupted: nothing was written")]
    Interrupted,
    /// The options of a built-in run can't be parsed.
    #[error("a built-in run has wrong options: {0}")]
    Typed(String),
    /// Only grey cameras can follow boundaries.
    #[error("--motion boundary needs pictures: add --sensor grey-camera")]
    BoundaryNeedsPictures,
    /// All robots together would have too many tiles.
    #[error(
        "--robots and --tiles: {robots} robots with {tiles} tiles each have more than {most} together; \
         lower one of them"
    )]
    TooManyTiles {
        /// Number of robots.
        robots: usize,
        /// Tiles in each robot's pool.
        tiles: usize,
        /// Maximum number of tiles of all robots.
        most: usize,
    },
    /// Cameras can't be calibrated.
    #[error(transparent)]
    Calibrate(#[from] calibrate::CalibrateFault),
    /// Cameras can't be placed.
    #[error(transparent)]
    Place(#[from] place::PlaceFault),
    /// A map used as walls is rotated.
    #[error("{path}: origin: a map used as walls must have a yaw of 0, not {:.4} rad", .yaw_rad, path = path.display())]
    TurnedMap {
        /// The map.
        path: PathBuf,
        /// Its yaw, in radians.
        yaw_rad: f64,
    },
}

impl RunError {
    /// Whether the options or input files are at fault, rather than the run itself.
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::Log(_)
            | Self::Frames(_)
            | Self::Robots { .. }
            | Self::Labels { .. }
            | Self::Deployment { .. }
            | Self::Control { .. }
            | Self::Parameter { .. }
            | Self::Map(_)
            | Self::Output(_)
            | Self::Store(_)
            | Self::Scenario(_)
            | Self::Port(_)
            | Self::Markers(_)
            | Self::NoCheck { .. }
            | Self::Capture { .. }
            | Self::Unsealed { .. }
            | Self::Keys(_)
            | Self::Provision(_)
            | Self::Poses { .. }
            | Self::Robot(_)
            | Self::Registry(_)
            | Self::TooManyRobots { .. }
            | Self::NoSuchCamera { .. }
            | Self::OneRobot { .. }
            | Self::NoCameraForOutside
            | Self::Scale { .. }
            | Self::BoundaryNeedsPictures
            | Self::TooManyTiles { .. }
            | Self::Calibrate(_)
            | Self::TurnedMap { .. } => true,
            Self::Place(fault) => fault.is_bad_input(),
            Self::Bench { .. } | Self::Interrupted | Self::Typed(_) => false,
            Self::Print(_) | Self::Grid(_) | Self::Picture(_) | Self::Randomness(_) => false,
        }
    }
}

impl From<ConfigError> for RunError {
    fn from(error: ConfigError) -> Self {
        Self::Robot(error)
    }
}

/// The error, with the options that cure it.
fn explain(error: &ConfigError) -> String {
    match error {
        ConfigError::Range => format!("{error}; change --max-range or --resolution"),
        _ => error.to_string(),
    }
}
