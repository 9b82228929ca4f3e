//! The options of `ubimap`'s commands, checked as they are parsed.

use std::path::PathBuf;

use clap::{ArgAction, Args, ValueEnum, value_parser};
use log::LevelFilter;
use ubimap_agent::map::Policy;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

use super::outside::OutsidePorts;
use crate::{
    channel::fault::Faults,
    recording::{DepthSlice, Format, PixelModel, Slicing, UpAxis},
    world::NAMED,
};

/// Options of `ubimap replay`.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Log")]
pub struct ReplayOptions {
    /// Recorded logs of one sensor: files, or folders of depth images
    #[arg(required = true, value_name = "LOG")]
    pub logs: Vec<PathBuf>,

    /// Format of the logs
    #[arg(long, value_enum, default_value_t)]
    pub format: FormatChoice,

    /// Number of robots: the log is cut into as many consecutive segments, played at the same time
    #[arg(long, help_heading = "Robots and map", value_name = "N", default_value_t = 1, value_parser = robots(), allow_negative_numbers = true)]
    pub robots: u16,

    /// Side of a cell in metres
    #[arg(long, help_heading = "Robots and map", value_name = "M", default_value = "0.05", value_parser = resolution, allow_negative_numbers = true)]
    pub resolution: Millimetres,

    /// Maximum range that is mapped, in metres
    #[arg(long, help_heading = "Robots and map", value_name = "M", default_value = "4.0", value_parser = max_range, allow_negative_numbers = true)]
    pub max_range: Millimetres,

    /// Which readings are mapped, after Aluckal et al.: all; scans after a motion; without what was in
    /// view before a turn; without what is already known
    #[arg(long, help_heading = "Robots and map", value_name = "P", value_enum, default_value_t = PolicyName::Full)]
    pub policy: PolicyName,

    /// How depth images become scans.
    #[command(flatten)]
    pub slicing: SlicingOptions,

    /// Options common to all runs.
    #[command(flatten)]
    pub run: RunOptions,
}

/// How depth images become scans.
#[derive(Args, Clone, Copy, Debug)]
#[command(next_help_heading = "Depth images")]
pub struct SlicingOptions {
    /// Which part of a depth image is mapped
    #[arg(long, value_enum, default_value_t)]
    pub slice: DepthSlice,

    /// What a column of a depth image means
    #[arg(long, value_enum, default_value_t)]
    pub pixel_model: PixelModel,

    /// Which axis of the cameras' poses points up
    #[arg(long, value_enum, value_name = "AXIS", default_value_t, allow_hyphen_values = true)]
    pub up: UpAxis,
}

impl SlicingOptions {
    /// Converts to the options of the log reader.
    pub fn slicing(&self) -> Slicing {
        Slicing { slice: self.slice, pixels: self.pixel_model, up: self.up }
    }
}

/// Options of `ubimap simulate`.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Scenario")]
pub struct SimulateOptions {
    /// A scenario: a file (TOML), or the name of a built-in one: room, warehouse,
    /// changing, office or ahmed-2013
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

    /// Let the robots drive the scenario's routes, instead of exploring by themselves under the
    /// server's coordination
    #[arg(long, help_heading = "Cameras and robots")]
    pub scripted: bool,

    /// When robots that drive themselves take scans
    #[arg(long, help_heading = "Cameras and robots", value_enum, default_value_t)]
    pub motion: MotionName,

    /// Number of robots, instead of the scenario's
    #[arg(long, help_heading = "Cameras and robots", value_name = "N", value_parser = robots(), allow_negative_numbers = true)]
    pub robots: Option<u16>,

    /// Let the robots read an A010 depth camera and drive a Create 2, byte by byte through the drivers
    /// of a real robot; their own sensors are replaced
    #[arg(long, help_heading = "Cameras and robots", conflicts_with_all = ["scripted", "outside"])]
    pub drivers: bool,

    /// Let a robot outside, such as a board or an emulator, be the scenario's robot, in real time: its
    /// serial ports to the server, to a simulated A010 depth camera and to a simulated Create 2
    #[arg(long, help_heading = "Cameras and robots", value_name = "SERVER,SENSOR,WHEELS", conflicts_with_all = ["scripted", "motion", "tiles"])]
    pub outside: Option<OutsidePorts>,

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

    /// Options common to all runs.
    #[command(flatten)]
    pub run: RunOptions,
}

/// Options of `ubimap watch`.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Recording")]
pub struct WatchOptions {
    /// Folders of cameras, or of such folders: pose.txt, intrinsics.toml, depth/*.png, color/*.png
    /// (with a pose.txt and intrinsics.toml of its own, if it has them), and times.txt
    #[arg(required = true, value_name = "FOLDER")]
    pub folders: Vec<PathBuf>,

    /// The robots and their markers, instead of the robots.toml in a folder
    #[arg(long, value_name = "TOML")]
    pub robots: Option<PathBuf>,

    /// Side of a cell in metres
    #[arg(long, value_name = "M", default_value = "0.05", value_parser = resolution, allow_negative_numbers = true)]
    pub resolution: Millimetres,

    /// Options for the results.
    #[command(flatten)]
    pub results: ResultOptions,
}

/// Options of `ubimap serve`.
#[derive(Args, Clone, Debug)]
pub struct ServeOptions {
    /// Serial ports, with one robot behind each
    #[arg(required = true, value_name = "PORT")]
    pub ports: Vec<PathBuf>,

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

/// The requested format of a log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum FormatChoice {
    /// Detected from the content
    #[default]
    Auto,
    /// CARMEN text with FLASER records, plain or gzipped
    Carmen,
    /// CoreSLAM's mine robot, plain or gzipped
    Mines,
    /// A folder of depth images with poses and intrinsics
    Rgbd,
}

impl FormatChoice {
    /// The format, or `None` to detect it from the content.
    pub fn format(self) -> Option<Format> {
        match self {
            Self::Auto => None,
            Self::Carmen => Some(Format::Carmen),
            Self::Mines => Some(Format::Mines),
            Self::Rgbd => Some(Format::Rgbd),
        }
    }
}

/// Why the value of an option is invalid.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub(super) enum OptionError {
    #[error("not a number")]
    NotANumber,
    #[error("must be from {least} to {most} {unit}")]
    OutOfRange { least: f64, most: f64, unit: &'static str },
    #[error("must be whole millimetres")]
    FractionOfMillimetre,
    #[error("must be X,Y,DEG: metres, metres, degrees")]
    NotAPose,
}

fn robots() -> clap::builder::RangedI64ValueParser<u16> {
    value_parser!(u16).range(1..=1_000)
}

/// A number within bounds.
pub(super) fn number(
    text: &str,
    least: f64,
    most: f64,
    unit: &'static str,
) -> Result<f64, OptionError> {
    let value: f64 = text.parse().map_err(|_| OptionError::NotANumber)?;
    if (least..=most).contains(&value) {
        Ok(value)
    } else {
        Err(OptionError::OutOfRange { least, most, unit })
    }
}

fn probability(text: &str) -> Result<f64, OptionError> {
    number(text, 0.0, 1.0, "(a probability)")
}

/// When self-driving robots take scans.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum MotionName {
    /// They scan as they drive
    #[default]
    OnTheMove,
    /// They stop for each scan until the cameras have localised them there, as Ahmed et al. did
    StopAndWait,
}

/// The names of the policies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PolicyName {
    /// All readings of all scans.
    Pilot,
    /// All readings of scans after a motion.
    Threshold,
    /// The same, without what was in view before the robot turned.
    Omission,
    /// The same, without what is already known.
    Full,
}

impl From<PolicyName> for Policy {
    fn from(name: PolicyName) -> Self {
        match name {
            PolicyName::Pilot => Self::Pilot,
            PolicyName::Threshold => Self::Threshold,
            PolicyName::Omission => Self::Omission,
            PolicyName::Full => Self::Full,
        }
    }
}

fn resolution(text: &str) -> Result<Millimetres, OptionError> {
    let metres = number(text, 0.02, 1.0, "m")?;
    if ((metres * 1000.0).round() - metres * 1000.0).abs() > 1e-6 {
        return Err(OptionError::FractionOfMillimetre);
    }
    Ok(Millimetres::from_metres(metres))
}

fn max_range(text: &str) -> Result<Millimetres, OptionError> {
    number(text, 0.1, 65.0, "m").map(Millimetres::from_metres)
}

fn tolerance(text: &str) -> Result<f64, OptionError> {
    number(text, 0.0, 1e6, "m")
}

fn pose(text: &str) -> Result<Pose, OptionError> {
    let parts: Vec<&str> = text.split(',').map(str::trim).collect();
    let [x, y, heading] = parts[..] else { return Err(OptionError::NotAPose) };
    let metres = |text| number(text, -10_000.0, 10_000.0, "m");
    let degrees = number(heading, -360.0, 360.0, "degrees")?;
    Ok(Pose::from_metres(metres(x)?, metres(y)?, degrees.to_radians()))
}

fn seconds(text: &str) -> Result<Duration, OptionError> {
    let seconds = number(text, 0.1, 1e6, "s")?;
    Ok(Duration::from_micros((seconds * 1e6).round() as u64))
}

fn milliseconds(text: &str) -> Result<Duration, OptionError> {
    let milliseconds = number(text, 0.0, 60_000.0, "ms")?;
    Ok(Duration::from_micros((milliseconds * 1e3).round() as u64))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    #[test]
    fn values_are_checked() {
        assert_eq!(probability("0.3"), Ok(0.3));
        assert!(
            ["-0.1", "1.1", "nan", "inf", "x", ""].iter().all(|text| probability(text).is_err())
        );
        assert_eq!(resolution("0.05"), Ok(Millimetres(50)));
        assert_eq!(resolution("0.029"), Ok(Millimetres(29)));
        assert_eq!(resolution("0.0505"), Err(OptionError::FractionOfMillimetre));
        assert!(resolution("0").is_err() && max_range("-4").is_err());
        assert_eq!(milliseconds("0.25"), Ok(Duration::from_micros(250)));
        assert_eq!(pose("-1.5, 2,90"), Ok(Pose::from_metres(-1.5, 2.0, FRAC_PI_2)));
        assert_eq!(pose("1,2"), Err(OptionError::NotAPose));
        assert_eq!(pose("1,2,x"), Err(OptionError::NotANumber));
        assert!(pose("1,inf,0").is_err() && pose("1,2,400").is_err());
    }
}
