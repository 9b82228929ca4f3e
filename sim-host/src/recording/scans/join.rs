//! Joins several logs of one sensor.

use std::path::PathBuf;

use ubimap_protocol::time::Duration;

use super::{
    odometry::{compose, relative},
    scan_log::{Log, LoggedScan},
};
use crate::recording::error::LogError;

/// Joins logs of one sensor. The paths are only used in errors. The time and the odometry of each
/// log are shifted to continue those of the previous log, because the logs' `odom` frames are
/// unrelated.
///
/// # Errors
/// [`LogError::Mixed`] if sensors or kinds of poses differ, [`LogError::Empty`] if there is no log.
pub fn concatenate(logs: Vec<(PathBuf, Log)>) -> Result<Log, LogError> {
    let mut logs = logs.into_iter();
    let Some((first, mut joined)) = logs.next() else {
        return Err(LogError::Empty { path: PathBuf::new(), record: "logs" });
    };
    for (path, log) in logs {
        let mixed = |what| LogError::Mixed { path: path.clone(), first: first.clone(), what };
        let has = |scans: &[LoggedScan]| {
            scans.first().map(|scan| (scan.pose.is_some(), scan.odometry.is_some()))
        };
        if log.sensor != joined.sensor {
            return Err(mixed("sensor"));
        }
        if has(&log.scans) != has(&joined.scans) {
            return Err(mixed("kind of poses (corrected, or odometry only)"));
        }
        append(&mut joined, log);
    }
    Ok(joined)
}

fn append(joined: &mut Log, log: Log) {
    let times = |index: usize| joined.scans.get(index).map(|scan| scan.time.micros());
    let last_index = joined.scans.len().wrapping_sub(1);
    let last_time = times(last_index).unwrap_or(0);
    let gap = times(last_index.wrapping_sub(1)).map_or(1_000_000, |before| last_time - before);
    let start = Duration::from_micros(last_time + gap);

    let end_of = |scans: &[LoggedScan]| scans.last().and_then(|scan| scan.odometry);
    let begin_of = |scans: &[LoggedScan]| scans.first().and_then(|scan| scan.odometry);
    let odometry_shift = end_of(&joined.scans).zip(begin_of(&log.scans));
    if odometry_shift.is_some() {
        joined.notes.push("the odometry of each log continues that of the previous log".to_owned());
    }
    if let Some(more) = log.exposure {
        *joined.exposure.get_or_insert_default() += more;
    }
    joined.scans.extend(log.scans.into_iter().map(|mut scan| {
        scan.time = start + scan.time;
        scan.odometry = scan.odometry.map(|pose| match odometry_shift {
            Some((end, begin)) => compose(end, relative(begin, pose)),
            None => pose,
        });
        scan
    }));
    joined.warnings.extend(log.warnings);
    joined.notes.extend(log.notes);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::{Format, Sensor};

    fn scan(seconds: u64, x: f64) -> LoggedScan {
        LoggedScan {
            time: Duration::from_secs(seconds),
            readings_mm: vec![0; 2],
            pose: None,
            odometry: Some([x, 0.0, 0.0]),
            line: 1,
        }
    }

    fn log(step_rad: f64, scans: Vec<LoggedScan>) -> Log {
        let sensor = Sensor::Radial { first_rad: 0.0, step_rad, beams: 2 };
        Log {
            format: Format::Mines,
            sensor,
            scans,
            exposure: None,
            warnings: Vec::new(),
            notes: Vec::new(),
        }
    }

    #[test]
    fn joined_logs_continue_time_and_odometry() {
        let first = log(0.1, vec![scan(0, 5.0), scan(3, 6.0)]);
        let second = log(0.1, vec![scan(0, 1.0), scan(1, 1.5)]);
        let joined = concatenate(vec![("a".into(), first.clone()), ("b".into(), second)]).unwrap();
        let seen: Vec<_> = joined.scans.iter().map(|scan| (scan.time, scan.odometry)).collect();
        let expected = [(0, 5.0), (3, 6.0), (6, 6.0), (7, 6.5)];
        assert_eq!(seen, expected.map(|(s, x)| (Duration::from_secs(s), Some([x, 0.0, 0.0]))));

        let other = log(0.2, vec![scan(0, 0.0)]);
        let error = concatenate(vec![("a".into(), first), ("b".into(), other)]).unwrap_err();
        assert_eq!(
            error.to_string(),
            "b: its sensor differs from that of a; replay them one by one"
        );
    }
}
