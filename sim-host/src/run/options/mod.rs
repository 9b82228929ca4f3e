//! The options of `ubimap`'s commands, checked as they are parsed.

mod keys;
mod knock;
mod replay;
mod selection;
mod simulate;
mod values;

use std::path::PathBuf;

use clap::{ArgAction, Args, ValueEnum, value_parser};
use log::LevelFilter;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

pub use keys::{KeysAction, KeysOptions};
pub use knock::Knock;
pub use replay::{FormatChoice, ReplayOptions, SlicingOptions};
pub use selection::{GateName, PolicyName, SelectionOptions};
pub use simulate::{MotionName, PeerMaskName, SensorName, SimulateOptions};
pub(super) use values::{OptionError, heights, milliseconds, number, pose, resolution, seconds};
use values::{depth_scale, probability, tolerance};

use crate::{
    channel::{address::Address, fault::Faults},
    recording::ExposureRule,
};

/// Options of `ubimap watch`.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Recording")]
pub struct WatchOptions {
    /// Folders of cameras, or of such folders: pose.txt (x y z qx qy qz qw, or a matrix from camera to
    /// world) or a trajectory (TUM, Redwood), intrinsics.toml or a camera's .yaml or .json (OpenCV, ROS,
    /// Open3D), depth/*.png, color/*.png or rgb/*.png (with files of its own, if it has them), and times.txt
    #[arg(required = true, value_name = "FOLDER")]
    pub folders: Vec<PathBuf>,

    /// The robots and their markers, instead of the robots.toml in a folder
    #[arg(long, value_name = "TOML")]
    pub robots: Option<PathBuf>,

    /// Poses of the cameras, by their names, instead of those in the folders: a file that ubimap
    /// calibrate or place has written
    #[arg(long, value_name = "FILE")]
    pub cameras: Option<PathBuf>,

    /// When to correct the height and the tilt of a camera by the floor that it sees: if the floor is off by
    /// more than 1 cm or 0.5 degrees in five images and fills a tenth of the view, whenever it is found, or never
    #[arg(long, value_name = "WHEN", value_enum, default_value_t)]
    pub trust_floor: TrustFloor,

    /// Heights above the floor in metres between which things block robots [default: 0.03 to the height of
    /// the tallest robot, or 0.3]
    #[arg(long, value_name = "LOW,HIGH", value_parser = heights, allow_negative_numbers = true)]
    pub obstacles: Option<[Millimetres; 2]>,

    /// What is done where the picture is over- or underexposed; needs pictures of the same size as the
    /// depth images
    #[arg(long, value_enum, default_value_t)]
    pub exposure: ExposureRule,

    /// Where chairs, doors, people and cabinets are, which weighs how soon the map forgets: a file like
    /// labels.toml (see grid/labels.rs)
    #[arg(long, value_name = "FILE")]
    pub labels: Option<PathBuf>,

    /// The unit of the depth images.
    #[command(flatten)]
    pub unit: DepthUnit,

    /// Side of a cell in metres
    #[arg(long, value_name = "M", default_value = "0.05", value_parser = resolution, allow_negative_numbers = true)]
    pub resolution: Millimetres,

    /// Options for the results.
    #[command(flatten)]
    pub results: ResultOptions,
}

/// The unit of depth images.
#[derive(Args, Clone, Copy, Debug, Default)]
pub struct DepthUnit {
    /// Units of the depth images in a metre (1000: millimetres, 5000: TUM), or metres in a unit (0.001)
    /// [default: what the camera's file states, or else 1000]
    #[arg(long = "depth-scale", value_name = "UNITS", value_parser = depth_scale, allow_negative_numbers = true)]
    pub per_metre: Option<f64>,
}

/// When a camera's pose is corrected by its floor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum TrustFloor {
    /// If it is clearly off, and fills enough of the view
    #[default]
    Auto,
    /// Whenever it is found
    Always,
    /// Not at all: only report it
    Never,
}

/// Options of `ubimap serve`.
#[derive(Args, Clone, Debug)]
pub struct ServeOptions {
    /// The file of a deployment (see `ubimap init`); or, on a bench, serial ports with one robot behind
    /// each, and sockets for any number of robots: udp:4000 or tcp:4000 on this machine,
    /// udp:0.0.0.0:4000 from everywhere
    #[arg(required = true, value_name = "PORT")]
    pub ports: Vec<Address>,

    /// Require sealed frames on all ports and sockets, with the keys in this folder: see `ubimap keys`
    #[arg(long, value_name = "DIR")]
    pub keys: Option<PathBuf>,

    /// As --keys keys
    #[arg(long, conflicts_with = "keys")]
    pub sealed: bool,

    /// Open the sockets to everyone who reaches them, on a bench: their frames are not sealed
    #[arg(long, conflicts_with_all = ["keys", "sealed"])]
    pub open: bool,

    /// Send the robots of a deployment to ground that no camera sees
    #[arg(long)]
    pub explore: bool,

    /// Speed of the ports in bits per second
    #[arg(long, value_name = "N", default_value_t = 115_200, value_parser = value_parser!(u32).range(1_200..=12_000_000))]
    pub baud: u32,

    /// Pose of the robot on the bench, in metres and degrees, in place of cameras; once for all ports,
    /// or once for each in their order. Without it no fix is sent
    #[arg(long, value_name = "X,Y,DEG", value_parser = pose, allow_hyphen_values = true)]
    pub pose: Vec<Pose>,

    /// Side of a cell in metres; the robots' must be the same
    #[arg(long, value_name = "M", default_value = "0.05", value_parser = resolution, allow_negative_numbers = true)]
    pub resolution: Millimetres,

    /// Store the map in this file, and continue from its content; without it, the map is lost when
    /// the server ends. Copy it with `ubimap backup`
    #[arg(long, value_name = "FILE")]
    pub store: Option<PathBuf>,

    /// Duration in seconds; without it, until stopped
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: Option<Duration>,

    /// Print only the report, as JSON, to standard output
    #[arg(long)]
    pub json: bool,
}

/// Options common to all runs.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Run")]
pub struct RunOptions {
    /// Faults of the channels.
    #[command(flatten)]
    pub channel: ChannelOptions,

    /// Seed of all random numbers: the same seed gives the same report
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,

    /// Tiles in each robot's pool, instead of the firmware's bound
    #[arg(long, value_name = "N", value_parser = value_parser!(u32).range(1..=65_536))]
    pub tiles: Option<u32>,

    /// Where chairs, doors, people and cabinets are, which weighs how soon the map forgets: a file like
    /// labels.toml (see grid/labels.rs); in addition to a scenario's own labels
    #[arg(long, value_name = "FILE")]
    pub labels: Option<PathBuf>,

    /// Store the map in this file, and continue from its content
    #[arg(long, value_name = "FILE", help_heading = "Results")]
    pub store: Option<PathBuf>,

    /// Options for the results.
    #[command(flatten)]
    pub results: ResultOptions,
}

/// Options for the results of a run.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Results")]
pub struct ResultOptions {
    /// Folder for the map (map.pgm, map.yaml), the pictures (*.png), report.json and, of watch, robots.csv.
    /// Results of an earlier run in it are replaced when the run has succeeded
    #[arg(long, value_name = "DIR", default_value = "ubimap-out")]
    pub out: PathBuf,

    /// Print only the report, as JSON, to standard output; the folder is written as well
    #[arg(long)]
    pub json: bool,
}

/// What is logged to standard error. `RUST_LOG` overrides it.
#[derive(Args, Clone, Copy, Debug)]
#[command(next_help_heading = "Messages")]
pub struct Verbosity {
    /// More messages, and all figures at the end; -vv for details
    #[arg(short, long, action = ArgAction::Count, global = true)]
    pub verbose: u8,

    /// Errors only: no warnings and no progress
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub quiet: bool,
}

impl Verbosity {
    /// The least important level that is logged.
    pub fn level(self) -> LevelFilter {
        match self.verbose {
            _ if self.quiet => LevelFilter::Error,
            0 => LevelFilter::Warn,
            1 => LevelFilter::Info,
            2 => LevelFilter::Debug,
            _ => LevelFilter::Trace,
        }
    }
}

/// Faults of the channel between the server and each robot, in both directions. Probabilities are
/// from 0 to 1.
#[derive(Args, Clone, Copy, Debug, Default, PartialEq)]
#[command(next_help_heading = "Channel between the server and each robot")]
pub struct ChannelOptions {
    /// Probability that a frame is lost
    #[arg(long, value_name = "P", default_value_t = 0.0, value_parser = probability, allow_negative_numbers = true)]
    pub loss: f64,

    /// Probability that a frame arrives twice
    #[arg(long, value_name = "P", default_value_t = 0.0, value_parser = probability, allow_negative_numbers = true)]
    pub duplicate: f64,

    /// Probability that a frame is overtaken by later ones
    #[arg(long, value_name = "P", default_value_t = 0.0, value_parser = probability, allow_negative_numbers = true)]
    pub reorder: f64,

    /// Probability that bits of a frame are flipped
    #[arg(long, value_name = "P", default_value_t = 0.0, value_parser = probability, allow_negative_numbers = true)]
    pub corrupt: f64,

    /// Delay of a frame, in milliseconds
    #[arg(long, value_name = "MS", default_value = "0", value_parser = milliseconds, allow_negative_numbers = true)]
    pub latency: Duration,

    /// Interrupt the channel for ten seconds, from this second on
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub cut: Option<Duration>,
}

/// Duration of an interruption.
const CUT: Duration = Duration::from_secs(10);

impl ChannelOptions {
    /// Converts to the faults of a wire.
    pub fn faults(&self) -> Faults {
        Faults {
            loss: self.loss,
            duplicate: self.duplicate,
            reorder: self.reorder,
            corrupt: self.corrupt,
            latency: self.latency,
            cut: self.cut.map(|from| (Instant(0) + from, Instant(0) + from + CUT)),
            ..Faults::default()
        }
    }
}

/// Options of `ubimap backup`.
#[derive(Args, Clone, Debug)]
pub struct BackupOptions {
    /// The file of `--store`; the program that uses it may be running
    #[arg(value_name = "STORE")]
    pub store: PathBuf,

    /// The copy, a file that `--store` accepts; an earlier backup is replaced once the new one is
    /// complete and checked
    #[arg(value_name = "FILE")]
    pub to: PathBuf,
}

/// Options of `ubimap compare`.
#[derive(Args, Clone, Debug)]
pub struct CompareOptions {
    /// The map's YAML file, in the format of ROS's map_server
    #[arg(value_name = "MAP.yaml")]
    pub map: PathBuf,

    /// The YAML file of the reference map
    #[arg(value_name = "REFERENCE.yaml")]
    pub reference: PathBuf,

    /// Maximum distance between matching occupied cells, in metres [default: one cell of the
    /// reference]
    #[arg(long, value_name = "M", value_parser = tolerance, allow_negative_numbers = true)]
    pub tolerance: Option<f64>,

    /// Print the scores as JSON
    #[arg(long)]
    pub json: bool,
}
