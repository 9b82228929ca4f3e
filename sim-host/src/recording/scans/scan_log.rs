//! A log of scans, independent of its format.

use ubimap_protocol::time::Duration;

use super::sensor::Sensor;
use crate::recording::format::Format;

/// One scan of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedScan {
    /// Time since the first scan; strictly increasing.
    pub time: Duration,
    /// Readings in millimetres, one for each direction of [`Sensor`]; 0 for no return, whatever the log's code for it.
    pub readings_mm: Vec<u16>,
    /// Pose of the sensor in `map`: x and y in metres, heading in radians.
    pub pose: Option<[f64; 3]>,
    /// Pose of the robot in `odom`: x and y in metres, heading in radians.
    pub odometry: Option<[f64; 3]>,
    /// The line in the file, or the number of the frame; both from 1.
    pub line: usize,
}

/// A log: at least one scan, all of one sensor; either all scans have a pose or none, and the same holds
/// for odometry.
#[derive(Clone, Debug, PartialEq)]
pub struct Log {
    /// The format it was read from.
    pub format: Format,
    /// The sensor that took the scans.
    pub sensor: Sensor,
    /// The scans in order of time.
    pub scans: Vec<LoggedScan>,
    /// Warnings for the user, one line each: what may make the map wrong.
    pub warnings: Vec<String>,
    /// Notes for the user, one line each.
    pub notes: Vec<String>,
}
