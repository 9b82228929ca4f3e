//! Logs of scans: a reader for each format, and the common representation.

mod carmen;
mod join;
mod mines;
mod odometry;
mod read;
mod rgbd;
mod scan_log;
mod sensor;
mod slicing;

pub use join::concatenate;
pub use read::{read, read_all};
pub use scan_log::{Log, LoggedScan};
pub use sensor::Sensor;
pub use slicing::{DepthSlice, PixelModel, Slicing};
