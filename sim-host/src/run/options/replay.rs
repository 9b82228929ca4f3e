//! The options of `ubimap replay`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use ubimap_protocol::units::{Millimetres, Pose};

use super::{
    DepthUnit, RunOptions, SelectionOptions,
    values::{max_range, pose, resolution, robots},
};
use crate::recording::{DepthSlice, ExposureRule, Format, PixelModel, Slicing, UpAxis};

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

    /// Pose of the robot at the first scan of a log with odometry alone, in metres and degrees, so that the new map shares
    /// the frame of an existing one [default: as the log's odometry]
    #[arg(long, help_heading = "Robots and map", value_name = "X,Y,DEG", value_parser = pose, allow_hyphen_values = true)]
    pub start: Option<Pose>,

    /// Which readings are mapped.
    #[command(flatten)]
    pub selection: SelectionOptions,

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

    /// What is done where the picture of the same number, in color or rgb, is over- or underexposed
    #[arg(long, value_enum, default_value_t)]
    pub exposure: ExposureRule,

    /// The unit of the depth images.
    #[command(flatten)]
    pub unit: DepthUnit,

    /// Which axis of the cameras' poses points up
    #[arg(long, value_enum, value_name = "AXIS", default_value_t, allow_hyphen_values = true)]
    pub up: UpAxis,
}

impl SlicingOptions {
    /// Converts to the options of the log reader.
    pub fn slicing(&self) -> Slicing {
        let depth_per_metre = self.unit.per_metre;
        Slicing {
            slice: self.slice,
            pixels: self.pixel_model,
            exposure: self.exposure,
            up: self.up,
            depth_per_metre,
        }
    }
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
