//! The options of `ubimap calibrate`.

use std::path::PathBuf;

use clap::Args;

use super::super::options::{DepthUnit, OptionError, number};

/// A file of observations, as the help shows it.
const EXAMPLE: &str = "\
A file of landmarks states for each camera what it sees, in its optical frame (x right, y down, z forward), in
metres: rows of [label, x, y, z], or of [x, y, z] without labels. Floor and noise are optional:

    [[cameras]]
    name = \"camera-00\"
    floor = { normal = [0.0, -0.5, -0.866], height_m = 2.9 }     # its upward normal
    noise = { lateral_m = 0.004, depth_m = 0.001, depth_per_m = 0.00475 }
    landmarks = [[\"red\", 0.52, -0.31, 2.74], [\"blue\", -0.8, 0.1, 2.9]]";

/// Options of `ubimap calibrate`.
#[derive(Args, Clone, Debug)]
#[command(after_help = EXAMPLE)]
pub struct CalibrateOptions {
    /// A folder of recorded frames, of a robot that is steered through the views of all cameras (the
    /// folders of ubimap watch, of which no poses are needed); or a file of landmarks (TOML)
    #[arg(value_name = "RECORDING|OBSERVATIONS")]
    pub observations: PathBuf,

    /// The robots of a recording and their markers, instead of its robots.toml
    #[arg(long, value_name = "TOML")]
    pub robots: Option<PathBuf>,

    /// The unit of the depth images.
    #[command(flatten)]
    pub unit: DepthUnit,

    /// The camera whose pose is given by --cameras or by the recording, or else defines the origin [default: the first
    /// one]
    #[arg(long, value_name = "CAMERA")]
    pub reference: Option<String>,

    /// A cameras.toml with the pose of the reference. Other keys of its cameras are kept, other
    /// poses are ignored. Without it the pose in the recording counts; without that the floor gives
    /// height and tilt if a camera sees it, and the reference stands at x = y = 0 with heading 0
    #[arg(long, value_name = "FILE")]
    pub cameras: Option<PathBuf>,

    /// Weight all landmarks equally, as in UbiSLAM's cost C, instead of by their noise
    #[arg(long)]
    pub unweighted: bool,

    /// Maximum distance between the two measurements of a landmark, in standard deviations of their
    /// noise
    #[arg(long, value_name = "SIGMAS", default_value = "4", value_parser = gate, allow_negative_numbers = true)]
    pub gate: f64,

    /// File for the calibrated cameras, in the form of cameras.toml
    #[arg(long, value_name = "FILE", default_value = "calibrated-cameras.toml")]
    pub out: PathBuf,

    /// Print the report as JSON, and nothing else, on standard output
    #[arg(long)]
    pub json: bool,
}

fn gate(text: &str) -> Result<f64, OptionError> {
    number(text, 1.0, 100.0, "sigma")
}
