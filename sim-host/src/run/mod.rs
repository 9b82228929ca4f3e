//! What drives a deployment: a file for each of `ubimap`'s commands, their options, and the fleet
//! of simulated robots. Each driver brings a clock, sources and channels; what is decided is
//! decided in the [`deployment`](crate::deployment).

pub mod compare;
mod convergence;
mod driving;
mod figures;
pub mod fleet;
pub mod heap;
pub mod keeper;
mod markers;
pub mod member;
pub mod options;
pub mod place;
mod progress;
pub mod record;
pub mod replay;
mod robots_file;
pub mod room_stage;
pub mod scan_log;
pub mod scoring;
pub mod serve;
pub mod simulate;
pub mod terminal;
mod time_lapse;
pub mod watch;

use std::path::PathBuf;

use image::RgbImage;
use serde::Serialize;
use ubimap_agent::{
    ConfigError, Part,
    map::{MAX_RADIUS, MIN_RESOLUTION},
};

use crate::{
    channel::serial::SerialError,
    grid::{self, GridError, MapError, OccupancyGrid},
    perception::robots::RegistryError,
    recording::{FramesError, LogError},
    report::{self, Caption, Marker, OutputError, OutputFolder, Report},
    store::StoreError,
    world::ScenarioError,
};

/// What a run ends with that draws a map.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome<R = Report> {
    /// The figures.
    pub report: R,
    /// The fused map.
    pub map: OccupancyGrid,
    /// The robots, people and cameras when the last frame or scan had been looked at.
    pub markers: Vec<Marker>,
    /// What the pictures show, and when.
    pub caption: Caption,
    /// More pictures, by the names of their files.
    pub pictures: Vec<(&'static str, RgbImage)>,
    /// Tables as text, by the names of their files.
    pub tables: Vec<(&'static str, String)>,
}

impl<R: Serialize> Outcome<R> {
    /// Writes `map.pgm`, `map.yaml`, `map.png`, `report.json`, the other pictures and the tables: all
    /// of them or none.
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

/// Why a run could not be made or finished. Each is one line.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A log can't be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// Recorded frames can't be watched.
    #[error(transparent)]
    Frames(#[from] FramesError),
    /// A file of robots can't be used.
    #[error("{path}: {reason}", path = path.display())]
    Robots {
        /// The file.
        path: PathBuf,
        /// Why not, on one line.
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
    /// The map can't be kept.
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
    Port(#[from] SerialError),
    /// There are neither as many poses as ports, nor one, nor none.
    #[error("--pose: given {poses} times for {ports} ports; give one for all, or one for each")]
    Poses {
        /// Poses given.
        poses: usize,
        /// Ports given.
        ports: usize,
    },
    /// The robots can't work with these options.
    #[error("no robot can be made with these options: {}", explain(.0))]
    Robot(ConfigError),
    /// The robots' markers can't be told apart.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// The scenario has fewer robots.
    #[error("--robots {asked}: the scenario has {there}")]
    TooManyRobots {
        /// Robots asked for.
        asked: usize,
        /// Robots in the scenario.
        there: usize,
    },
    /// Cameras can't be placed.
    #[error(transparent)]
    Place(#[from] place::PlaceFault),
    /// A map that is to be the walls lies askew.
    #[error("{path}: origin: walls must lie straight, but the map is turned by {yaw_rad} rad", path = path.display())]
    TurnedMap {
        /// The map.
        path: PathBuf,
        /// Its yaw.
        yaw_rad: f64,
    },
}

impl RunError {
    /// Whether what was given to the run is at fault, and not the run.
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::Log(_)
            | Self::Frames(_)
            | Self::Robots { .. }
            | Self::Map(_)
            | Self::Output(_)
            | Self::Store(_)
            | Self::Scenario(_)
            | Self::Port(_)
            | Self::Poses { .. }
            | Self::Robot(_)
            | Self::Registry(_)
            | Self::TooManyRobots { .. }
            | Self::TurnedMap { .. } => true,
            Self::Place(fault) => fault.is_bad_input(),
            Self::Grid(_) | Self::Picture(_) | Self::Randomness(_) => false,
        }
    }
}

impl From<ConfigError> for RunError {
    fn from(error: ConfigError) -> Self {
        Self::Robot(error)
    }
}

fn explain(error: &ConfigError) -> String {
    match error {
        ConfigError::Resolution => {
            format!("the cells must be {} mm wide or more", MIN_RESOLUTION.0)
        }
        ConfigError::Range => {
            format!("the range must be 1 to {MAX_RADIUS} cells; change --max-range or --resolution")
        }
        ConfigError::Memory { part, needed, found } => {
            let what = match part {
                Part::Beams => "readings in a scan",
                Part::Waiting => "readings of scans that wait",
                Part::Scratch => "words of scratch memory",
                Part::OwnTiles => "tiles",
                Part::FusedTiles => "fused tiles",
            };
            format!("{needed} {what} are needed, there is memory for {found}")
        }
    }
}
