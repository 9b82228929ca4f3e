//! The options of `ubimap simulate`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use ubimap_agent::map::PeerMask;
use ubimap_protocol::time::Duration;

use super::{
    PolicyName, RunOptions, SelectionOptions,
    knock::Knock,
    values::{OptionError, number, robots, seconds},
};
use crate::{
    recording::{ExposureRule, PixelModel},
    run::outside::{robot::Place, serial_ports},
    world::{NAMED, Scenario},
};

/// What a robot outside does by itself, and the channel to it, which can't be spoilt from here.
const SIMULATED: [&str; 17] = [
    "scripted",
    "motion",
    "sensor",
    "peer_mask",
    "policy",
    "gate",
    "pixel_model",
    "exposure",
    "drivers",
    "tiles",
    "points",
    "loss",
    "duplicate",
    "reorder",
    "corrupt",
    "latency",
    "cut",
];

/// Options of `ubimap simulate`.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Scenario")]
pub struct SimulateOptions {
    /// A scenario: a file (TOML), or the name of a built-in one: room, warehouse,
    /// changing, office, ahmed-2013, ahmed-2013-b, aluckal-room, awareness
    /// or ubislam-figure-1
    #[arg(default_value = NAMED[0].0)]
    pub scenario: PathBuf,

    /// ROS map (map.yaml) with the walls, for a scenario without an outline of its own: of the built-in
    /// ones, office
    #[arg(long, value_name = "YAML")]
    pub map: Option<PathBuf>,

    /// Use ideal cameras that know what is in view, instead of rendering and analysing their frames:
    /// faster, and more accurate than any camera
    #[arg(long, help_heading = "Cameras and robots")]
    pub ideal_cameras: bool,

    /// Calibrate the cameras first, by what they see while one robot is steered through their views for a
    /// minute, and use the poses found instead of the true ones; only the first camera's pose is known
    #[arg(long, help_heading = "Cameras and robots", conflicts_with = "ideal_cameras")]
    pub calibrate: bool,

    /// Knock a camera at a time, which nobody tells the server: the camera's number (from 0), the time in
    /// seconds, a shift in metres, and changes of heading, tilt and roll in degrees; several times if
    /// need be. The same as knocks of a camera in a scenario, where they can also take time
    #[arg(
        long,
        help_heading = "Cameras and robots",
        value_name = "CAMERA@S:X,Y,Z,HEADING,TILT,ROLL",
        conflicts_with = "ideal_cameras"
    )]
    pub knock: Vec<Knock>,

    /// Let the robots drive the scenario's routes, instead of exploring by themselves under the
    /// server's coordination
    #[arg(long, help_heading = "Cameras and robots")]
    pub scripted: bool,

    /// When robots that drive themselves take scans
    #[arg(long, help_heading = "Cameras and robots", value_enum, default_value_t)]
    pub motion: MotionName,

    /// The robots' sensor, instead of the scenario's
    #[arg(long, help_heading = "Cameras and robots", value_enum, default_value_t, conflicts_with_all = ["drivers", "log"])]
    pub sensor: SensorName,

    /// What robots leave out around other robots
    #[arg(long, help_heading = "Cameras and robots", value_enum, default_value_t)]
    pub peer_mask: PeerMaskName,

    /// Also let the robots estimate their poses as if there were no cameras, by odometry alone and by their
    /// own scan matching, and report the errors
    #[arg(long, help_heading = "Results")]
    pub baselines: bool,

    /// Turn every robot's identifier by this angle on the robot, counter-clockwise, in addition to the
    /// scenario's mounting errors
    #[arg(long, help_heading = "Cameras and robots", value_name = "DEG", default_value_t = 0.0, value_parser = askew, allow_negative_numbers = true)]
    pub identifier_askew: f64,

    /// Which readings are mapped.
    #[command(flatten)]
    pub selection: SelectionOptions,

    /// What a column of a robot's depth camera means
    #[arg(long, help_heading = "Cameras and robots", value_enum, default_value_t)]
    pub pixel_model: PixelModel,

    /// What is done where a robot's depth camera is over- or underexposed
    #[arg(long, help_heading = "Cameras and robots", value_enum, default_value_t)]
    pub exposure: ExposureRule,

    /// Number of robots, instead of the scenario's
    #[arg(long, help_heading = "Cameras and robots", value_name = "N", value_parser = robots(), allow_negative_numbers = true)]
    pub robots: Option<u16>,

    /// Let the robots read an A010 depth camera and drive a Create 2, byte by byte through the drivers
    /// of a real robot; their own sensors are replaced
    #[arg(long, help_heading = "Cameras and robots", conflicts_with = "scripted")]
    pub drivers: bool,

    /// Let a robot outside, such as a board or an emulator, be the scenario's robot, in real time: its
    /// serial ports to the server, to a simulated A010 depth camera and to a simulated Create 2
    #[arg(long, help_heading = "Cameras and robots", value_name = "SERVER,SENSOR,WHEELS", conflicts_with = "in_step", conflicts_with_all = SIMULATED)]
    pub outside: Option<serial_ports::Paths>,

    /// Let a command run the scenario's robot, such as an emulator with an image: the same ports over its standard
    /// input and output, in the simulation's time, which is that of the command
    #[arg(long, help_heading = "Cameras and robots", value_name = "COMMAND", conflicts_with_all = SIMULATED)]
    pub in_step: Option<String>,

    /// Ignore the labels and classes of the scenario
    #[arg(long)]
    pub no_classes: bool,

    /// Duration in seconds, instead of the scenario's
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: Option<Duration>,

    /// Write the frames of the cameras to this folder, new or empty, for ubimap watch
    #[arg(long, help_heading = "Results", value_name = "DIR", conflicts_with = "ideal_cameras")]
    pub record: Option<PathBuf>,

    /// Write the robots' scans to this file, a CARMEN log for ubimap replay: one robot after another,
    /// so that --robots N plays N of them at once; gzipped if the name ends with .gz
    #[arg(long, help_heading = "Results", value_name = "FILE")]
    pub log: Option<PathBuf>,

    /// Write the points that the robots' policy selects to this file, as x and y in metres: the pointset of
    /// Aluckal et al.
    #[arg(long, help_heading = "Results", value_name = "FILE.csv")]
    pub points: Option<PathBuf>,

    /// Options common to all runs.
    #[command(flatten)]
    pub run: RunOptions,
}

fn askew(text: &str) -> Result<f64, OptionError> {
    number(text, -180.0, 180.0, "degrees")
}

impl SimulateOptions {
    /// Whether the points of the robots' scans are of interest: if they are asked for, if the room spoils
    /// depths, or if a policy is compared.
    pub(crate) fn keeps_points(&self, scenario: &Scenario) -> bool {
        let compares = self.selection.policy != PolicyName::Full
            || self.pixel_model != PixelModel::Pinhole
            || self.exposure != ExposureRule::Any;
        self.points.is_some() || !scenario.glare.is_empty() || compares
    }

    /// Where the robot is, if it is outside the simulation.
    pub(crate) fn place(&self) -> Option<Place> {
        let ports = self.outside.clone().map(Place::Ports);
        ports.or_else(|| self.in_step.clone().map(Place::Command))
    }

    /// Whether the server leads the robots.
    pub(crate) fn is_led(&self) -> bool {
        !self.scripted && self.motion != MotionName::Boundary
    }
}

/// When self-driving robots take scans.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum MotionName {
    /// They scan as they drive
    #[default]
    OnTheMove,
    /// They stop for each scan until the cameras have localised them there, as Ahmed et al. did
    StopAndWait,
    /// They follow boundaries by their pictures alone, and stop for each picture until the cameras have
    /// localised them there, as Ahmed's robots did
    Boundary,
}

/// Sensors that can replace those of a scenario.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum SensorName {
    /// The range sensors of the scenario
    #[default]
    Range,
    /// A grey camera on each robot, whose pictures it segments onboard (Ahmed et al.)
    GreyCamera,
}

/// The shapes of the masks around other robots.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum PeerMaskName {
    /// Their footprint, at their heading
    #[default]
    Footprint,
    /// A square that contains the footprint at any heading, as Ahmed et al. did
    Square,
    /// Nothing is left out
    None,
}

impl From<PeerMaskName> for PeerMask {
    fn from(name: PeerMaskName) -> Self {
        match name {
            PeerMaskName::Footprint => Self::Footprint,
            PeerMaskName::Square => Self::Square,
            PeerMaskName::None => Self::None,
        }
    }
}
