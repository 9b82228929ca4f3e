//! Logs of scans: a reader for each format, a writer of CARMEN logs, and the common representation.

mod carmen;
mod carmen_writer;
mod floor;
mod join;
mod mines;
mod odometry;
mod read;
mod rgbd;
mod scan_log;
mod sensor;
mod slicing;

pub use carmen_writer::write_carmen;
pub use join::concatenate;
pub use read::{read, read_all};
pub use scan_log::{Log, LoggedScan};
pub use sensor::Sensor;
pub use slicing::{DepthSlice, PixelModel, Slicing, UpAxis};
