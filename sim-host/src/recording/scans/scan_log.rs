//! A log of scans, independent of its format.

use ubimap_protocol::time::Duration;

use super::sensor::Sensor;
use crate::recording::{exposure::ExposureCounts, format::Format};

/// One scan of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedScan {
    /// Time since the first scan; strictly increasing.
    pub time: Duration,
    /// Readings in millimetres, one for each direction of the [`Sensor`]; 0 for no return, in all
    /// formats.
    pub readings_mm: Vec<u16>,
    /// Pose of the sensor in `map`: x and y in metres, heading in radians.
    pub pose: Option<[f64; 3]>,
    /// Pose of the robot in `odom`: x and y in metres, heading in radians.
    pub odometry: Option<[f64; 3]>,
    /// The line in the file, or the number of the frame; both from 1.
    pub line: usize,
}

/// A log of at least one scan, all of the same sensor. Either all scans have a pose or none has;
/// the same applies to odometry.
#[derive(Clone, Debug, PartialEq)]
pub struct Log {
    /// The format from which the log was read.
    pub format: Format,
    /// The sensor that took the scans.
    pub sensor: Sensor,
    /// The scans in order of time.
    pub scans: Vec<LoggedScan>,
    /// The pixels that were looked at for their exposure, if a rule asked for it.
    pub exposure: Option<ExposureCounts>,
    /// Warnings for the user about what may make the map wrong, one line each.
    pub warnings: Vec<String>,
    /// Notes for the user, one line each.
    pub notes: Vec<String>,
}
