//! The options of `ubimap place`.

use std::path::PathBuf;

use clap::{Args, ValueEnum, value_parser};

use super::super::options::{OptionError, number};
use crate::placement::{
    camera::Projection,
    milp::MilpSolver,
    placing::{Aim, CriticalRule},
};

/// Options of `ubimap place`.
#[derive(Args, Clone, Debug)]
pub struct PlaceOptions {
    /// A ROS map (map.yaml), whose occupied cells are walls up to the ceiling, or a scenario: a file
    /// (TOML), or the name of a built-in one
    #[arg(value_name = "ROOM")]
    pub room: PathBuf,

    /// The camera: a file (TOML) with keys of a scenario's cameras but for the pose, or the
    /// intrinsics.toml of a camera folder (then add range_m if it isn't 8 m) [default: the depth
    /// camera of a D435, 87 x 58 degrees, 8 m]
    #[arg(long, value_name = "FILE")]
    pub camera: Option<PathBuf>,

    /// Heights at which cameras may hang, in metres [default: 0.1 m below a scenario's ceiling, 3 m
    /// in a map]
    #[arg(long, value_name = "M,...", value_delimiter = ',', value_parser = height, allow_negative_numbers = true)]
    pub height: Vec<f64>,

    /// Tilts of the cameras in degrees, 0 level, 90 straight down [default: 90,60,45; 90 with the
    /// paper's model]
    #[arg(long, value_name = "DEG,...", value_delimiter = ',', value_parser = tilt, allow_negative_numbers = true)]
    pub tilt: Vec<f64>,

    /// Headings around the circle [default: 8; 4 with the paper's model]
    #[arg(long, value_name = "N", value_parser = value_parser!(u16).range(1..=360))]
    pub headings: Option<u16>,

    /// One place for a camera in each square of this side, in metres [default: the side of a cell,
    /// doubled while that gives more than 60,000 candidates]
    #[arg(long, value_name = "M", value_parser = spacing, allow_negative_numbers = true)]
    pub spacing: Option<f64>,

    /// Side of a cell of the floor in metres
    #[arg(long, value_name = "M", default_value = "0.5", value_parser = cell, allow_negative_numbers = true)]
    pub cell: f64,

    /// A cell counts as covered from this number of cameras on
    #[arg(long, value_name = "M", default_value_t = 1, value_parser = value_parser!(u16).range(1..=100))]
    pub min_overlap: u16,

    /// No more cameras than this may see a cell [default: any number]
    #[arg(long, value_name = "K", value_parser = value_parser!(u16).range(1..=1000))]
    pub max_overlap: Option<u16>,

    /// Cover as much as possible with this number of cameras, in place of everything with the fewest
    #[arg(long, value_name = "N", value_parser = value_parser!(u16).range(1..=10_000))]
    pub cameras: Option<u16>,

    /// Cover this share of the floor (0 to 1) with the fewest cameras, in place of all of it
    #[arg(long, value_name = "F", value_parser = share, allow_negative_numbers = true, conflicts_with = "cameras")]
    pub coverage: Option<f64>,

    /// An image whose lighter half of the grey scale marks the critical floor: of the size of the
    /// map's image, or, for a drawn room, of a pixel for each cell, north up
    #[arg(long, value_name = "IMAGE")]
    pub critical: Option<PathBuf>,

    /// What critical floor asks for
    #[arg(long, value_name = "RULE", value_enum, default_value_t, requires = "critical")]
    pub critical_rule: CriticalRuleName,

    /// Which floor a camera sees
    #[arg(long, value_enum, default_value_t)]
    pub model: ModelName,

    /// Add cameras, or with --cameras cover less, where the overlap would not connect all cameras for
    /// calibration; without it they are moved if that costs nothing
    #[arg(long)]
    pub connect: bool,

    /// What solves the integer programme
    #[arg(long, value_enum, default_value_t)]
    pub solver: SolverName,

    /// Take the best placement so far after this time, in seconds; Ctrl-C does so at once
    #[arg(long, value_name = "S", default_value = "30", value_parser = time_limit, allow_negative_numbers = true)]
    pub time_limit: f64,

    /// Seed of all random numbers
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,

    /// Folder for cameras.toml, coverage.png and report.json
    #[arg(long, value_name = "DIR", default_value = "ubimap-place")]
    pub out: PathBuf,

    /// Print the report as JSON, and nothing else, on standard output
    #[arg(long)]
    pub json: bool,
}

impl PlaceOptions {
    /// What is asked for.
    pub(super) fn aim(&self) -> Aim {
        match (self.cameras, self.coverage) {
            (Some(cameras), _) => Aim::Cameras(cameras.into()),
            (None, Some(share)) => Aim::Share(share),
            (None, None) => Aim::Cover,
        }
    }
}

/// Which floor a camera sees.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum ModelName {
    /// What a tilted pinhole sees within its range, less the shadows of walls and furniture
    #[default]
    True,
    /// UbiSLAM's rectangle below a camera that looks straight down, whatever stands there
    Paper,
}

impl From<ModelName> for Projection {
    fn from(name: ModelName) -> Self {
        match name {
            ModelName::True => Self::Pinhole,
            ModelName::Paper => Self::Paper,
        }
    }
}

/// What critical floor asks for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum CriticalRuleName {
    /// Two cameras at least
    #[default]
    Twice,
    /// It counts five times, with --cameras or --coverage
    Weighted,
    /// Other floor is left out
    Only,
}

impl From<CriticalRuleName> for CriticalRule {
    fn from(name: CriticalRuleName) -> Self {
        match name {
            CriticalRuleName::Twice => Self::Twice,
            CriticalRuleName::Weighted => Self::Weighted,
            CriticalRuleName::Only => Self::Only,
        }
    }
}

/// What solves the integer programme.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum SolverName {
    /// Local search and bounds made for cameras
    #[default]
    Search,
    /// The same for a fifth of the time, then microlp
    Microlp,
    /// The same for a fifth of the time, then HiGHS
    #[cfg(feature = "highs")]
    Highs,
}

impl SolverName {
    /// The solver that follows the usual one.
    pub(super) fn milp(self) -> Option<MilpSolver> {
        match self {
            Self::Search => None,
            Self::Microlp => Some(MilpSolver::Microlp),
            #[cfg(feature = "highs")]
            Self::Highs => Some(MilpSolver::Highs),
        }
    }
}

fn height(text: &str) -> Result<f64, OptionError> {
    number(text, 0.1, 100.0, "m")
}

fn tilt(text: &str) -> Result<f64, OptionError> {
    number(text, -90.0, 90.0, "degrees")
}

fn spacing(text: &str) -> Result<f64, OptionError> {
    number(text, 0.05, 100.0, "m")
}

fn cell(text: &str) -> Result<f64, OptionError> {
    number(text, 0.05, 10.0, "m")
}

fn share(text: &str) -> Result<f64, OptionError> {
    number(text, 0.0, 1.0, "(a share)")
}

fn time_limit(text: &str) -> Result<f64, OptionError> {
    number(text, 0.1, 86_400.0, "s")
}
