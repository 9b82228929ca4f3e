//! The options of `ubimap`'s commands, checked as they are parsed.

use std::path::PathBuf;

use clap::{ArgAction, Args, ValueEnum, value_parser};
use log::LevelFilter;
use ubimap_agent::map::Policy;
use ubimap_protocol::{
    time::{Duration, Instant},
    units::{Millimetres, Pose},
};

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

    /// What the logs are
    #[arg(long, value_enum, default_value_t)]
    pub format: FormatChoice,

    /// Cut the log into this many consecutive segments, one robot each, all at the same time
    #[arg(long, help_heading = "Robots and map", value_name = "N", default_value_t = 1, value_parser = robots(), allow_negative_numbers = true)]
    pub robots: u16,

    /// Side of a cell in metres
    #[arg(long, help_heading = "Robots and map", value_name = "M", default_value = "0.05", value_parser = resolution, allow_negative_numbers = true)]
    pub resolution: Millimetres,

    /// Map nothing beyond this range, in metres
    #[arg(long, help_heading = "Robots and map", value_name = "M", default_value = "4.0", value_parser = max_range, allow_negative_numbers = true)]
    pub max_range: Millimetres,

    /// How much of what the sensors say is mapped, as Aluckal et al. compare it: every scan; those
    /// after a motion; less what was in view before a turn; less all that is known
    #[arg(long, help_heading = "Robots and map", value_name = "P", value_enum, default_value_t = PolicyName::Full)]
    pub policy: PolicyName,

    /// How depth images become scans.
    #[command(flatten)]
    pub slicing: SlicingOptions,

    /// What every run has.
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
    /// The same, as the reader of logs takes it.
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

    /// Take the walls from a ROS map (map.yaml) in place of the scenario's; office needs one
    #[arg(long, value_name = "YAML")]
    pub map: Option<PathBuf>,

    /// Let the cameras know what is in view, in place of drawing and looking at their frames:
    /// quicker, and better than any camera
    #[arg(long, help_heading = "Cameras and robots")]
    pub ideal_cameras: bool,

    /// Let the robots drive the scenario's routes, in place of driving themselves where nobody has
    /// been, under the server's coordination
    #[arg(long, help_heading = "Cameras and robots")]
    pub scripted: bool,

    /// How robots that drive themselves come to their scans
    #[arg(long, help_heading = "Cameras and robots", value_enum, default_value_t)]
    pub motion: MotionName,

    /// How many robots drive, in place of the scenario's number
    #[arg(long, help_heading = "Cameras and robots", value_name = "N", value_parser = robots(), allow_negative_numbers = true)]
    pub robots: Option<u16>,

    /// How long they drive in seconds, in place of the scenario's time
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: Option<Duration>,

    /// Write the frames of the cameras to this folder, new or empty, for ubimap watch
    #[arg(long, help_heading = "Results", value_name = "DIR", conflicts_with = "ideal_cameras")]
    pub record: Option<PathBuf>,

    /// Write what the robots' sensors read to this file, a CARMEN log for ubimap replay: robot after
    /// robot, so that --robots N plays N of them at once; gzipped if the name ends with .gz
    #[arg(long, help_heading = "Results", value_name = "FILE")]
    pub log: Option<PathBuf>,

    /// What every run has.
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

    /// The robots and their markers, in place of the robots.toml in a folder
    #[arg(long, value_name = "TOML")]
    pub robots: Option<PathBuf>,

    /// Side of a cell in metres
    #[arg(long, value_name = "M", default_value = "0.05", value_parser = resolution, allow_negative_numbers = true)]
    pub resolution: Millimetres,

    /// Where the results go.
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

    /// Until there are real cameras: where the robot stands on the bench, in metres and degrees;
    /// once for all ports, or once for each in their order. Without it no fix is sent
    #[arg(long, value_name = "X,Y,DEG", value_parser = pose, allow_hyphen_values = true)]
    pub pose: Vec<Pose>,

    /// Side of a cell in metres; the robots' must be the same
    #[arg(long, value_name = "M", default_value = "0.05", value_parser = resolution, allow_negative_numbers = true)]
    pub resolution: Millimetres,

    /// Keep the map in this file, and go on from what it holds; without it, the map
    /// is lost with the server
    #[arg(long, value_name = "FILE")]
    pub store: Option<PathBuf>,

    /// How long to serve, in seconds; without it, until stopped
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub duration: Option<Duration>,

    /// Print the report as JSON, and nothing else, on standard output
    #[arg(long)]
    pub json: bool,
}

/// Options that every run has.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Run")]
pub struct RunOptions {
    /// What the channels do.
    #[command(flatten)]
    pub channel: ChannelOptions,

    /// Seed of all random numbers: the same seed gives the same report
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,

    /// Tiles in each robot's pool, in place of the robots' real bound
    #[arg(long, value_name = "N", value_parser = value_parser!(u32).range(1..=65_536))]
    pub tiles: Option<u32>,

    /// Keep the map in this file, and go on from what it holds
    #[arg(long, value_name = "FILE", help_heading = "Results")]
    pub store: Option<PathBuf>,

    /// Where the results go.
    #[command(flatten)]
    pub results: ResultOptions,
}

/// Where the results of a run go.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Results")]
pub struct ResultOptions {
    /// Folder for the map (map.pgm, map.yaml), the pictures (*.png), the tables and report.json. Results
    /// of an earlier run in it are replaced when the run has succeeded
    #[arg(long, value_name = "DIR", default_value = "ubimap-out")]
    pub out: PathBuf,

    /// Print the report as JSON, and nothing else, on standard output; the folder is written as well
    #[arg(long)]
    pub json: bool,
}

/// How much is logged on standard error. `RUST_LOG` overrides it.
#[derive(Args, Clone, Copy, Debug)]
#[command(next_help_heading = "Messages")]
pub struct Verbosity {
    /// More messages, and all figures at the end; -vv for what happens in detail
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

/// What the channel between the server and each robot does to a frame, both ways. Probabilities are
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

    /// How long a frame takes, in milliseconds
    #[arg(long, value_name = "MS", default_value = "0", value_parser = milliseconds, allow_negative_numbers = true)]
    pub latency: Duration,

    /// Let nothing arrive for ten seconds from this second on
    #[arg(long, value_name = "S", value_parser = seconds, allow_negative_numbers = true)]
    pub cut: Option<Duration>,
}

/// How long a channel is cut.
const CUT: Duration = Duration::from_secs(10);

impl ChannelOptions {
    /// The same, as the wires take it.
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

/// Options of `ubimap compare`.
#[derive(Args, Clone, Debug)]
pub struct CompareOptions {
    /// The map's YAML file, as ROS's map_server has it
    #[arg(value_name = "MAP.yaml")]
    pub map: PathBuf,

    /// The YAML file of the map to hold it against
    #[arg(value_name = "REFERENCE.yaml")]
    pub reference: PathBuf,

    /// How far apart occupied cells may lie to count as the same, in metres [default: one cell of
    /// the reference]
    #[arg(long, value_name = "M", value_parser = tolerance, allow_negative_numbers = true)]
    pub tolerance: Option<f64>,

    /// Print the scores as JSON
    #[arg(long)]
    pub json: bool,
}

/// The format of a log, as it is asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum FormatChoice {
    /// Told by the content
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
    /// The format, or `None` to tell it by the content.
    pub fn format(self) -> Option<Format> {
        match self {
            Self::Auto => None,
            Self::Carmen => Some(Format::Carmen),
            Self::Mines => Some(Format::Mines),
            Self::Rgbd => Some(Format::Rgbd),
        }
    }
}

/// Why the value of an option is refused.
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

/// The names of the ways to come to a scan.
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
    /// Every scan, and all of it.
    Pilot,
    /// A scan when the robot has moved.
    Threshold,
    /// The same, less what was in view before the robot turned.
    Omission,
    /// The same, less all that is known already.
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
