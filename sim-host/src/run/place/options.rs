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

    /// The camera: a file (TOML) with the keys of a scenario's camera except the pose, or the
    /// intrinsics.toml of a camera folder (then add range_m if it isn't 8 m) [default: the depth
    /// camera of a D435, 87 x 58 degrees, 8 m]
    #[arg(long, value_name = "FILE")]
    pub camera: Option<PathBuf>,

    /// Horizontal and vertical field of view of the cameras' pictures in degrees, in which calibration finds
    /// landmarks: overlap counts as such where two pictures show it [default: that of picture in the camera's
    /// file, 69,42 for a D435; or else the whole view]
    #[arg(long, value_name = "H,V", value_parser = fields, allow_negative_numbers = true)]
    pub picture_fov: Option<[f64; 2]>,

    /// Side of the robots' markers in metres, as `marker_size_m` of a robot: only where both pictures show it
    /// large enough to be read, overlap counts
    #[arg(long, value_name = "M", default_value = "0.1", value_parser = marker, allow_negative_numbers = true)]
    pub marker: f64,

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

    /// Spacing of camera positions, in metres [default: the side of a cell, doubled while there are
    /// more than 60,000 candidates]
    #[arg(long, value_name = "M", value_parser = spacing, allow_negative_numbers = true)]
    pub spacing: Option<f64>,

    /// Side of a cell of the floor in metres
    #[arg(long, value_name = "M", default_value = "0.5", value_parser = cell, allow_negative_numbers = true)]
    pub cell: f64,

    /// Minimum number of cameras that must see a cell for it to count as covered
    #[arg(long, value_name = "M", default_value_t = 1, value_parser = value_parser!(u16).range(1..=100))]
    pub min_overlap: u16,

    /// Maximum number of cameras that may see a cell [default: no limit]
    #[arg(long, value_name = "K", value_parser = value_parser!(u16).range(1..=1000))]
    pub max_overlap: Option<u16>,

    /// Maximise the coverage with this number of cameras, instead of covering everything with the
    /// fewest
    #[arg(long, value_name = "N", value_parser = value_parser!(u16).range(1..=10_000))]
    pub cameras: Option<u16>,

    /// Cover only this share of the floor (0 to 1) with the fewest cameras
    #[arg(long, value_name = "F", value_parser = share, allow_negative_numbers = true, conflicts_with = "cameras")]
    pub coverage: Option<f64>,

    /// An image in which pixels of 50 % grey and lighter mark critical floor. Size: that of the
    /// map's image, or one pixel per cell for a scenario; north is up
    #[arg(long, value_name = "IMAGE")]
    pub critical: Option<PathBuf>,

    /// How critical floor is treated
    #[arg(long, value_name = "RULE", value_enum, default_value_t, requires = "critical")]
    pub critical_rule: CriticalRuleName,

    /// Which floor a camera sees
    #[arg(long, value_enum, default_value_t)]
    pub model: ModelName,

    /// Add cameras (with --cameras: accept less coverage) until overlapping pictures connect all
    /// cameras, as calibration requires. Without it cameras are only moved where that is free
    #[arg(long)]
    pub connect: bool,

    /// Solver of the integer programme
    #[arg(long, value_enum, default_value_t)]
    pub solver: SolverName,

    /// Time limit in seconds, after which the best placement found is taken; Ctrl-C does so at once
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
    /// The optimisation goal.
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
    /// The view of a tilted pinhole within its range, without the floor hidden by walls and
    /// furniture
    #[default]
    True,
    /// UbiSLAM's rectangle below a camera that looks straight down, ignoring obstacles
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

/// How critical floor is treated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum CriticalRuleName {
    /// At least two cameras must see it
    #[default]
    Twice,
    /// It counts five times; has an effect only with --cameras or --coverage
    Weighted,
    /// Only critical floor must be covered
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

/// Solver of the integer programme.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum SolverName {
    /// Local search, bounds, and branch and bound
    #[default]
    Search,
    /// The same for a fifth of the time, then microlp
    Microlp,
    /// The same for a fifth of the time, then HiGHS
    #[cfg(feature = "highs")]
    Highs,
}

impl SolverName {
    /// The solver that runs after the local search.
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

fn fields(text: &str) -> Result<[f64; 2], OptionError> {
    let (horizontal, vertical) = text.split_once(',').unwrap_or((text, ""));
    let field = |text: &str| number(text.trim(), 1.0, 170.0, "degrees");
    Ok([field(horizontal)?, field(vertical)?])
}

fn marker(text: &str) -> Result<f64, OptionError> {
    number(text, 0.02, 2.0, "m")
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
