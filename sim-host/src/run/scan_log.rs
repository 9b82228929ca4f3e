//! Writes the scans of simulated robots to a log for `ubimap replay`.

use std::{
    fs::File,
    io::{BufWriter, Write},
    path::{Path, PathBuf},
};

use flate2::{Compression, write::GzEncoder};
use nalgebra::{Isometry2, Vector2};
use ubimap_protocol::{time::Instant, units::Pose};

use super::RunError;
use crate::{
    recording::{LogError, LoggedScan, Sensor, write_carmen},
    world::{RangeSensor, ScanEvent, SimRobot},
};

/// The scans of a run, and the CARMEN log to write them to.
pub struct ScanLog {
    path: PathBuf,
    file: Box<dyn Write>,
    /// Pose of each robot's sensor in `base_link`.
    mounts: Vec<Pose>,
    robots: Vec<(Sensor, Vec<LoggedScan>)>,
}

impl ScanLog {
    /// Creates a log, gzipped if its name ends with ".gz".
    ///
    /// # Errors
    /// [`RunError::Log`] if it can't be written to.
    pub fn create(path: &Path, robots: &[SimRobot]) -> Result<Self, RunError> {
        let file = File::create(path).map_err(|error| refuse(path, error))?;
        let is_gzipped = path.extension().is_some_and(|it| it == "gz");
        let file: Box<dyn Write> = if is_gzipped {
            Box::new(GzEncoder::new(file, Compression::default()))
        } else {
            Box::new(BufWriter::new(file))
        };
        Ok(Self {
            path: path.to_owned(),
            file,
            mounts: robots.iter().map(|robot| robot.sensor().mount()).collect(),
            robots: robots.iter().map(|robot| (sensor(robot.sensor()), Vec::new())).collect(),
        })
    }

    /// Adds a scan, with its poses converted to those of the sensor.
    pub fn add(&mut self, scan: &ScanEvent) {
        let Some((mount, (_, scans))) =
            self.mounts.get(scan.robot).zip(self.robots.get_mut(scan.robot))
        else {
            return;
        };
        let of_sensor = |robot: Pose| {
            let pose = isometry(robot) * isometry(*mount);
            Some([pose.translation.x, pose.translation.y, pose.rotation.angle()])
        };
        scans.push(LoggedScan {
            time: scan.taken.since(Instant(0)),
            readings_mm: scan.readings_mm.clone(),
            pose: of_sensor(scan.truth),
            odometry: of_sensor(scan.odometry),
            line: scans.len() + 1,
        });
    }

    /// Writes all scans.
    ///
    /// # Errors
    /// [`RunError::Log`].
    pub fn finish(mut self) -> Result<(), RunError> {
        let written = write_carmen(&mut self.file, &self.robots);
        written.map_err(|error| refuse(&self.path, error))
    }
}

fn refuse(path: &Path, error: std::io::Error) -> RunError {
    LogError::Io { path: path.to_owned(), error }.into()
}

fn sensor(sensor: &RangeSensor) -> Sensor {
    match sensor.focal_px() {
        Some(fx) => {
            Sensor::Pinhole { fx, cx: (sensor.beams() - 1) as f64 / 2.0, width: sensor.beams() }
        }
        None => Sensor::Radial {
            first_rad: sensor.first_angle_rad(),
            step_rad: sensor.step_rad(),
            beams: sensor.beams(),
        },
    }
}

fn isometry(pose: Pose) -> Isometry2<f64> {
    Isometry2::new(Vector2::new(pose.x.metres(), pose.y.metres()), pose.heading.radians())
}
