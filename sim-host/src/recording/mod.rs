//! Recordings: logs of scans, and frames of cameras.
//!
//! [`read`] reads a log of range scans or depth rows, with poses or odometry. It detects the format
//! from the content:
//!
//! | format | content | poses | odometry |
//! |---|---|---|---|
//! | [`Format::Carmen`] | `FLASER` records, plain or gzipped | in corrected logs | in raw logs |
//! | [`Format::Mines`] | a hobby lidar and wheel encoders, plain or gzipped | none | from the ticks |
//! | [`Format::Rgbd`] | a folder of 16-bit depth images; one row of each | of the camera | none |
//!
//! Information that a log lacks (such as time stamps) is replaced by a documented rule.
//! [`Log::notes`] mentions this, or [`Log::warnings`] if it can make the map wrong.
//!
//! [`write_carmen`] writes the scans of robots as a CARMEN log.
//!
//! [`RecordedFrames`] plays the frames of RGB-D cameras, and [`Recorder`] writes them. [`frames`]
//! describes the layout on disk.

mod camera_forms;
mod camera_pose;
mod camera_poses;
mod depth_image;
mod error;
mod exposure;
mod format;
pub mod frames;
mod image_times;
mod intrinsics;
mod lines;
mod mounted;
mod numbered_files;
mod scans;
mod time_stamps;

pub use camera_forms::units_per_metre;
pub use error::{Field, FrameFault, LineFault, LogError};
pub use exposure::{ExposureCounts, ExposureRule};
pub use format::Format;
pub use frames::{FramesError, Reading, RecordedFrames, Recorder};
pub(crate) use intrinsics::IntrinsicsFile;
pub use scans::{
    DepthSlice, Log, LoggedScan, PixelModel, Sensor, Slicing, UpAxis, concatenate, read, read_all,
    write_carmen,
};
