//! The log of CoreSLAM's mine robot: a Hokuyo URG-04LX and two wheel encoders.
//!
//! Each line has 707 numbers. Number 0 is the time in microseconds, 2 and 3 are the ticks of the
//! left and the right wheel, and 24 to 705 are 682 ranges in millimetres over 240 degrees, with
//! beam 0 to the right. There are no poses.

use std::{f64::consts::PI, path::Path};

use super::{
    odometry::compose,
    scan_log::{Log, LoggedScan},
    sensor::Sensor,
};
use crate::recording::{
    error::{Field, LineFault, LogError},
    format::Format,
    lines::{Lines, number, reading},
    time_stamps,
};

const FIELDS: usize = 707;
const FIRST_RANGE: usize = 24;
const BEAMS: usize = 682;
const SPREAD_RAD: f64 = 240.0 / 180.0 * PI;

/// Minimum valid reading in millimetres; lower values are error codes.
const MIN_RANGE_MM: f64 = 20.0;
/// Maximum range of the scanner in millimetres.
const MAX_RANGE_MM: f64 = 5_600.0;

const WHEEL_RADIUS_M: f64 = 0.077;
const HALF_AXLE_M: f64 = 0.165;
const TICKS_A_TURN: f64 = 2_000.0;

/// Maximum speed of a wheel in m/s; above it, the counter must have wrapped or been reset.
const MAX_SPEED_M_S: f64 = 10.0;

/// Reads a log of the mine robot, plain or gzipped. Odometry starts at the origin of `odom`.
pub(super) fn read(path: &Path) -> Result<Log, LogError> {
    let mut records = Vec::new();
    let mut lines = Lines::open(path)?;
    while let Some(line) = lines.next() {
        let (number, text) = line?;
        if text.trim_ascii().is_empty() {
            continue;
        }
        records.push(Record::parse(number, text).map_err(|fault| LogError::Line {
            path: path.to_owned(),
            line: number,
            fault,
        })?);
    }
    if records.is_empty() {
        return Err(LogError::Empty { path: path.to_owned(), record: "scan" });
    }

    let stamps: Vec<f64> = records.iter().map(|record| record.stamp_s).collect();
    let (times, note) = time_stamps::repair(Some(&stamps), records.len());
    let mut notes: Vec<String> = note.into_iter().collect();
    let elapsed_s = times.windows(2).map(|pair| (pair[1].micros() - pair[0].micros()) as f64 / 1e6);
    let (poses, lost) = dead_reckon(&records, elapsed_s);
    if let Some(line) = lost.first() {
        notes.push(format!(
            "the wheel counters jump {} times (first at line {line}); no motion assumed there",
            lost.len()
        ));
    }
    let scans =
        records.into_iter().zip(times).zip(poses).map(|((record, time), pose)| LoggedScan {
            time,
            readings_mm: record.readings_mm,
            pose: None,
            odometry: Some(pose),
            line: record.line,
        });
    let sensor = Sensor::Radial {
        first_rad: -SPREAD_RAD / 2.0,
        step_rad: SPREAD_RAD / (BEAMS - 1) as f64,
        beams: BEAMS,
    };
    Ok(Log {
        format: Format::Mines,
        sensor,
        scans: scans.collect(),
        exposure: None,
        warnings: Vec::new(),
        notes,
    })
}

/// One line of the log.
struct Record {
    line: usize,
    stamp_s: f64,
    /// Ticks of the left and the right wheel.
    ticks: [f64; 2],
    readings_mm: Vec<u16>,
}

impl Record {
    fn parse(line: usize, text: &str) -> Result<Self, LineFault> {
        let fields: Vec<&str> = text.split_ascii_whitespace().collect();
        if fields.len() != FIELDS {
            return Err(LineFault::Fields { found: fields.len(), expected: FIELDS });
        }
        let ranges = fields[FIRST_RANGE..FIRST_RANGE + BEAMS].iter().enumerate();
        let readings_mm: Result<_, _> = ranges
            .map(|(index, text)| {
                let range = reading(text, index)?;
                let is_measured = (MIN_RANGE_MM..MAX_RANGE_MM).contains(&range);
                Ok(if is_measured { range.round() as u16 } else { 0 })
            })
            .collect();
        Ok(Self {
            line,
            stamp_s: number(fields[0], Field::Named("time"))? / 1e6,
            ticks: [
                number(fields[2], Field::Named("left ticks"))?,
                number(fields[3], Field::Named("right ticks"))?,
            ],
            readings_mm: readings_mm?,
        })
    }
}

/// Returns the poses in `odom`, computed from the wheel counters alone, and the lines whose
/// counters are unusable.
fn dead_reckon(
    records: &[Record],
    elapsed_s: impl Iterator<Item = f64>,
) -> (Vec<[f64; 3]>, Vec<usize>) {
    let mut pose = [0.0; 3];
    let mut poses = vec![pose];
    let mut lost = Vec::new();
    for (pair, elapsed_s) in records.windows(2).zip(elapsed_s) {
        let steps =
            [0, 1].map(|wheel| wheel_step_m(pair[0].ticks[wheel], pair[1].ticks[wheel], elapsed_s));
        if let [Some(left), Some(right)] = steps {
            let turn = (right - left) / (2.0 * HALF_AXLE_M);
            let forward = (left + right) / 2.0;
            // Move along the chord of the arc.
            let (sin, cos) = (turn / 2.0).sin_cos();
            pose = compose(pose, [forward * cos, forward * sin, turn]);
        } else {
            lost.push(pair[1].line);
        }
        poses.push(pose);
    }
    (poses, lost)
}

/// The distance in metres that a wheel rolled between two counts of ticks, corrected if a 16- or
/// 32-bit counter has wrapped; `None` if the counter was reset.
fn wheel_step_m(before: f64, after: f64, elapsed_s: f64) -> Option<f64> {
    let bits_16 = f64::from(1 << 16);
    let bits_32 = bits_16 * bits_16;
    [0.0, bits_16, -bits_16, bits_32, -bits_32]
        .map(|wrap| (after - before + wrap) / TICKS_A_TURN * 2.0 * PI * WHEEL_RADIUS_M)
        .into_iter()
        .find(|step| step.abs() <= MAX_SPEED_M_S * elapsed_s)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        recording::{self, Slicing},
        testing::{Folder, shared_data},
    };

    fn line(time: &str, left: i64, right: i64, ranges: &str) -> String {
        let mut fields = vec!["0"; FIELDS];
        let (left, right) = (left.to_string(), right.to_string());
        (fields[0], fields[2], fields[3]) = (time, &left, &right);
        for (field, range) in fields[FIRST_RANGE..].iter_mut().zip(ranges.split(' ')) {
            *field = range;
        }
        fields.join(" ") + "\n"
    }

    #[test]
    fn wheel_ticks_give_odometry() {
        let folder = Folder::new("mines-wheels");
        // The robot turns by a quarter on the spot, then drives a metre along y; the right counter
        // wraps.
        let quarter =
            (HALF_AXLE_M * PI / 2.0 / (2.0 * PI * WHEEL_RADIUS_M) * 2000.0).round() as i64;
        let metre = (1.0 / (2.0 * PI * WHEEL_RADIUS_M) * 2000.0).round() as i64;
        let text = line("0", 500, 65_000, "0")
            + &line("1000000", 500 - quarter, 65_000 + quarter - 65_536, "7 300 5580 5600")
            + &line("2000000", 500 - quarter + metre, 65_000 + quarter - 65_536 + metre, "0")
            + &line("3000000", 9_000_000, 0, "0");
        let log = read(&folder.file("wheels.dat", text.as_bytes())).unwrap();
        let odometry: Vec<_> = log.scans.iter().filter_map(|scan| scan.odometry).collect();
        assert!((odometry[1][2] - PI / 2.0).abs() < 1e-2);
        assert!((odometry[2][1] - 1.0).abs() < 1e-2 && odometry[2][0].abs() < 1e-2);
        assert_eq!(odometry[3], odometry[2]);
        assert!(log.notes.iter().any(|note| note.contains("line 4")), "{:?}", log.notes);
        assert_eq!(log.scans[1].readings_mm[..4], [0, 300, 5_580, 0]);
    }

    #[test]
    fn faults_name_the_line() {
        let folder = Folder::new("mines-faults");
        let good = line("0", 0, 0, "0");
        for (bad, expected) in [
            (line("1", 0, 0, "0 -1"), "reading 1: -1 is negative"),
            (line("1", 0, 0, "nan"), "reading 0: \"nan\""),
            (line("never", 0, 0, "0"), "time"),
            ("1 2 3\n".to_owned(), "3 fields where 707 are needed"),
        ] {
            let path = folder.file("bad.dat", (good.clone() + &bad + &good).as_bytes());
            let error = read(&path).unwrap_err().to_string();
            assert!(error.contains("bad.dat:2: ") && error.contains(expected), "{error}");
        }
    }

    #[test]
    fn recorded_logs_are_read() {
        let Some(folder) = shared_data("mines_coreslam") else { return };
        for (file, scans) in [("exp1.dat.gz", 756), ("exp2.dat.gz", 641)] {
            let log = recording::read(&folder.join(file), None, Slicing::default()).unwrap();
            assert_eq!((log.format, log.scans.len()), (Format::Mines, scans));
            assert_eq!(log.notes, Vec::<String>::new());
        }
    }
}
