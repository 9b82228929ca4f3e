//! CARMEN text logs.
//!
//! ```text
//! FLASER n r1 .. rn x y theta odom_x odom_y odom_theta ipc_time host log_time
//! ```
//!
//! The units are metres, radians and seconds. A scan covers half a turn, and beam 0 points to the
//! right. Other records are ignored.
//!
//! Corrected logs contain the corrected pose of the laser in both triples (`x y theta` and `odom_x
//! odom_y odom_theta`), and raw logs contain the odometry in both. The records alone do not show
//! which of the two it is. So if the triples agree, they are treated as poses, unless a comment in
//! the file mentions dead reckoning and the file contains no output of a corrector (`NEFF`).

use std::{f64::consts::PI, path::Path};

use super::{
    odometry::relative,
    scan_log::{Log, LoggedScan},
    sensor::Sensor,
};
use crate::recording::{
    error::{Field, LineFault, LogError},
    format::Format,
    lines::{Lines, coordinate, number, reading},
    time_stamps,
};

/// Ranges of readings in metres that mean "no return": SICK in centimetres (81.83, 81.91), other
/// scanners at 50 to 51.2, and 15 bits of millimetres (32.76). Tolerances for rounding are
/// included.
const NO_RETURN_M: [(f64, f64); 3] = [(81.8, f64::MAX), (49.9995, 51.2005), (32.755, 32.7705)];

/// "No return" of a SICK in millimetres, 13 bits. Applies only to logs without a greater reading.
const NO_RETURN_13_BITS_M: (f64, f64) = (8.1825, 8.1915);

/// Number of fields for the two poses, and for the times. A record also contains its kind, the
/// number of readings, and the readings.
const POSE_FIELDS: usize = 6;
const TIME_FIELDS: usize = 3;

/// Parameters that state the maximum range of the front laser in a log.
const MAXIMUM_PARAMS: [&str; 2] = ["robot_front_laser_max", "robot_frontlaser_max"];

/// Maximum number of beams accepted in a scan.
const MAX_BEAMS: usize = 16_384;

/// Whether a word could be the kind of a record, such as `FLASER`, `ODOM` or `ROBOTLASER1`.
pub(super) fn is_record_kind(word: &str) -> bool {
    word.len() <= 64
        && word.starts_with(|first: char| first.is_ascii_alphabetic())
        && word.chars().all(|letter| letter.is_ascii_alphanumeric() || "_-.:".contains(letter))
}

/// Reads a CARMEN log, plain or gzipped.
pub(super) fn read(path: &Path) -> Result<Log, LogError> {
    let mut content = Content::default();
    let mut lines = Lines::open(path)?;
    while let Some(line) = lines.next() {
        let (number, text) = line?;
        content.take_line(number, text).map_err(|fault| LogError::Line {
            path: path.to_owned(),
            line: number,
            fault,
        })?;
    }
    content
        .into_log()
        .ok_or_else(|| LogError::Empty { path: path.to_owned(), record: "FLASER record" })
}

/// One `FLASER` record.
struct Record {
    line: usize,
    ranges_m: Vec<f64>,
    /// Pose of the laser as stated in the log.
    laser: [f64; 3],
    /// Odometry pose of the robot as stated in the log.
    odometry: [f64; 3],
    stamp_s: Option<f64>,
}

/// The content of a file, collected line by line.
#[derive(Default)]
struct Content {
    records: Vec<Record>,
    stated_maximum_m: Option<f64>,
    speaks_of_dead_reckoning: bool,
    has_corrector_records: bool,
}

impl Content {
    fn take_line(&mut self, line: usize, text: &str) -> Result<(), LineFault> {
        let mut words = text.split_ascii_whitespace();
        let Some(kind) = words.next() else { return Ok(()) };
        if kind.starts_with('#') {
            let comment = text.to_ascii_lowercase();
            self.speaks_of_dead_reckoning |=
                comment.contains("dead-reckon") || comment.contains("dead reckon");
            return Ok(());
        }
        if !is_record_kind(kind) {
            return Err(LineFault::NotARecord(kind.chars().take(24).collect()));
        }
        match kind {
            "FLASER" => {
                let fields: Vec<&str> = words.collect();
                let record = Record::parse(line, &fields, self.records.first())?;
                self.records.push(record);
            }
            "NEFF" => self.has_corrector_records = true,
            "PARAM" if words.next().is_some_and(|name| MAXIMUM_PARAMS.contains(&name)) => {
                let value = words.next().and_then(|word| word.parse::<f64>().ok());
                self.stated_maximum_m = value.filter(|value| *value > 0.0);
            }
            _ => {}
        }
        Ok(())
    }

    fn into_log(self) -> Option<Log> {
        let beams = self.records.first()?.ranges_m.len();
        let mut notes = Vec::new();
        if ![180, 181, 360, 361].contains(&beams) {
            notes.push(format!("assuming that the {beams} beams cover half a turn"));
        }
        let stamps: Option<Vec<f64>> = self.records.iter().map(|record| record.stamp_s).collect();
        let (times, warning) = time_stamps::repair(stamps.as_deref(), self.records.len());
        let warnings = warning.into_iter().collect();
        let trajectories = self.trajectories();
        notes.extend(trajectories.note().map(str::to_owned));

        let limits = self.limits();
        let scans = self.records.into_iter().zip(times).map(|(record, time)| LoggedScan {
            time,
            readings_mm: record.ranges_m.iter().map(|range| limits.millimetres(*range)).collect(),
            pose: trajectories.has_poses().then_some(record.laser),
            odometry: match trajectories {
                Trajectories::Both | Trajectories::MovingOdometry => Some(record.odometry),
                Trajectories::DeadReckoned => Some(record.laser),
                Trajectories::Corrected | Trajectories::MovingPoses => None,
            },
            line: record.line,
        });
        Some(Log {
            format: Format::Carmen,
            sensor: sensor(beams),
            scans: scans.collect(),
            exposure: None,
            warnings,
            notes,
        })
    }

    fn limits(&self) -> Limits {
        let ranges = self.records.iter().flat_map(|record| &record.ranges_m);
        let greatest = ranges.copied().fold(0.0, f64::max);
        Limits {
            stated_m: self.stated_maximum_m.unwrap_or(f64::MAX),
            is_13_bits: greatest <= NO_RETURN_13_BITS_M.1,
        }
    }

    fn trajectories(&self) -> Trajectories {
        // The laser's offset on the robot is unknown, but constant: if poses and odometry differ by
        // a constant only, there is only one trajectory.
        let offsets = || self.records.iter().map(|record| relative(record.odometry, record.laser));
        let is_one = is_still(offsets());
        if is_one && self.speaks_of_dead_reckoning && !self.has_corrector_records {
            Trajectories::DeadReckoned
        } else if is_one {
            Trajectories::Corrected
        } else if is_still(self.records.iter().map(|record| record.laser)) {
            Trajectories::MovingOdometry
        } else if is_still(self.records.iter().map(|record| record.odometry)) {
            Trajectories::MovingPoses
        } else {
            Trajectories::Both
        }
    }
}

impl Record {
    /// Parses the fields after the kind. Every record must have the same layout as `first`.
    fn parse(line: usize, fields: &[&str], first: Option<&Self>) -> Result<Self, LineFault> {
        let counted = Field::Named("number of readings");
        let count = number(fields.first().copied().unwrap_or(""), counted)?;
        if count.fract() != 0.0 || !(2.0..=MAX_BEAMS as f64).contains(&count) {
            let reason = "not a number of beams (2 to 16384)";
            return Err(LineFault::OutOfRange { field: counted, value: count, reason });
        }
        let count = count as usize;
        if let Some(first) = first
            && first.ranges_m.len() != count
        {
            return Err(LineFault::Width { found: count, expected: first.ranges_m.len() });
        }

        // Either all records have the time fields or none has.
        let untimed = 1 + count + POSE_FIELDS;
        let timed = untimed + TIME_FIELDS;
        let expected = match first {
            Some(first) if first.stamp_s.is_none() => untimed,
            None if fields.len() == untimed => untimed,
            _ => timed,
        };
        if fields.len() != expected {
            return Err(LineFault::Fields { found: fields.len() + 1, expected: expected + 1 });
        }

        let ranges = fields[1..=count].iter().enumerate();
        let ranges_m: Result<_, _> = ranges.map(|(index, text)| reading(text, index)).collect();
        let field = |index: usize, name| {
            coordinate(number(fields[index], Field::Named(name))?, Field::Named(name))
        };
        let pose = |start: usize, [x, y, theta]: [&'static str; 3]| {
            Ok([field(start, x)?, field(start + 1, y)?, field(start + 2, theta)?])
        };
        Ok(Self {
            line,
            ranges_m: ranges_m?,
            laser: pose(1 + count, ["x", "y", "theta"])?,
            odometry: pose(4 + count, ["odom_x", "odom_y", "odom_theta"])?,
            stamp_s: match fields.get(untimed) {
                Some(text) => Some(number(text, Field::Named("ipc_time"))?),
                None => None,
            },
        })
    }
}

/// The contents of the two triples of pose fields.
#[derive(Clone, Copy, PartialEq)]
enum Trajectories {
    /// Poses and odometry, which differ.
    Both,
    /// Twice the same trajectory, treated as corrected poses.
    Corrected,
    /// Twice the same trajectory, declared to be odometry.
    DeadReckoned,
    /// The poses are constant, the odometry is not.
    MovingOdometry,
    /// The odometry is constant, the poses are not.
    MovingPoses,
}

impl Trajectories {
    fn has_poses(self) -> bool {
        matches!(self, Self::Both | Self::Corrected | Self::MovingPoses)
    }

    fn note(self) -> Option<&'static str> {
        match self {
            Self::Both => None,
            Self::Corrected => Some("poses and odometry are one trajectory; taken as poses"),
            Self::DeadReckoned => {
                Some("poses and odometry are one trajectory, dead-reckoned; taken as odometry")
            }
            Self::MovingOdometry => Some("the poses are constant; using odometry"),
            Self::MovingPoses => Some("the odometry is constant; using poses"),
        }
    }
}

/// Whether all poses are equal within a centimetre and half a degree.
fn is_still(mut poses: impl Iterator<Item = [f64; 3]>) -> bool {
    let Some(first) = poses.next() else { return true };
    poses.all(|pose| {
        let turn = (pose[2] - first[2]).rem_euclid(2.0 * PI);
        (pose[0] - first[0]).hypot(pose[1] - first[1]) < 0.01 && turn.min(2.0 * PI - turn) < 0.01
    })
}

/// The sensor with this number of beams over half a turn. If the number is odd, the first and the
/// last beam are at the edges; if it is even, there is no beam at the left edge.
fn sensor(beams: usize) -> Sensor {
    let steps = if beams % 2 == 1 { beams - 1 } else { beams };
    Sensor::Radial { first_rad: -PI / 2.0, step_rad: PI / steps as f64, beams }
}

/// The ranges that mean "no return".
struct Limits {
    stated_m: f64,
    is_13_bits: bool,
}

impl Limits {
    /// Converts a range to whole millimetres; 0 for no return, and for more than 65 m.
    fn millimetres(&self, range_m: f64) -> u16 {
        let within = |(least, most): (f64, f64)| (least..=most).contains(&range_m);
        let is_code = NO_RETURN_M.into_iter().any(within)
            || self.is_13_bits && within(NO_RETURN_13_BITS_M)
            || range_m >= self.stated_m;
        let millimetres = (range_m * 1000.0).round();
        if is_code || millimetres > f64::from(u16::MAX) { 0 } else { millimetres as u16 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        recording::{Slicing, read_all},
        testing::{Folder, shared_data},
    };

    /// A record with four beams.
    fn flaser(ranges: &str, poses: &str, time: &str) -> String {
        format!("FLASER 4 {ranges} {poses} {time} host {time}\n")
    }

    fn read_text(text: &str) -> Result<Log, LogError> {
        let name = format!("carmen-{:?}", std::thread::current().id());
        let folder = Folder::new(&name.replace(['(', ')'], ""));
        let file = folder.file("test.log", text.as_bytes());
        super::super::read(&file, Some(Format::Carmen), Slicing::default())
    }

    #[test]
    fn an_odd_number_of_beams_includes_both_edges() {
        let last_deg = |beams| match sensor(beams) {
            Sensor::Radial { first_rad, step_rad, beams } => {
                (first_rad + step_rad * (beams - 1) as f64).to_degrees()
            }
            Sensor::Pinhole { .. } | Sensor::LinearAngle { .. } => f64::NAN,
        };
        for (beams, expected) in [(180, 89.0), (181, 90.0), (360, 89.5), (361, 90.0)] {
            assert!((last_deg(beams) - expected).abs() < 1e-9, "{beams}");
        }
    }

    #[test]
    fn all_codes_for_no_return_become_zero() {
        let text = flaser("81.83 81.91 50 51.2", "0 0 0 0 0 0", "1")
            + &flaser("51.1 32.759 32.767 70", "0 0 0 0 0 0", "2")
            + &flaser("49.99 51.3 32.7 8.19", "0 0 0 0 0 0", "3")
            + &flaser("0 0.0004 0.0006 65.5", "0 0 0 0 0 0", "4");
        let log = read_text(&text).unwrap();
        let readings: Vec<_> = log.scans.iter().map(|scan| scan.readings_mm.clone()).collect();
        assert_eq!(readings[0], [0; 4]);
        assert_eq!(readings[1], [0; 4]);
        assert_eq!(readings[2], [49_990, 51_300, 32_700, 8_190]);
        assert_eq!(readings[3], [0, 0, 1, 65_500]);

        let mm_mode = read_text(&flaser("8.191 8.183 8.18 1", "0 0 0 0 0 0", "1")).unwrap();
        assert_eq!(mm_mode.scans[0].readings_mm, [0, 0, 8_180, 1_000]);
        let stated = "PARAM robot_front_laser_max 10.0 nohost 0\n".to_owned()
            + &flaser("10 10.5 9.99 1", "0 0 0 0 0 0", "1");
        assert_eq!(read_text(&stated).unwrap().scans[0].readings_mm, [0, 0, 9_990, 1_000]);
    }

    #[test]
    fn one_trajectory_is_taken_as_poses_unless_the_file_says_otherwise() {
        let two = flaser("1 1 1 1", "0 0 0 0 0 0", "1") + &flaser("1 1 1 1", "1 2 3 1 2 3", "2");
        let log = read_text(&two).unwrap();
        assert_eq!((log.scans[1].pose, log.scans[1].odometry), (Some([1.0, 2.0, 3.0]), None));

        let raw = format!("# odometry is dead-reckoned\n{two}");
        let log = read_text(&raw).unwrap();
        assert_eq!((log.scans[1].pose, log.scans[1].odometry), (None, Some([1.0, 2.0, 3.0])));
        assert!(read_text(&(raw + "NEFF 60\n")).unwrap().scans[0].pose.is_some());

        let both = flaser("1 1 1 1", "0 0 0 0 0 0", "1") + &flaser("1 1 1 1", "1 2 3 1.1 2 3", "2");
        let log = read_text(&both).unwrap();
        assert_eq!(log.scans[1].odometry, Some([1.1, 2.0, 3.0]));
        assert!(log.scans[1].pose.is_some());

        let unposed =
            flaser("1 1 1 1", "0 0 0 0 0 0", "1") + &flaser("1 1 1 1", "0 0 0 1 2 3", "2");
        let log = read_text(&unposed).unwrap();
        assert_eq!((log.scans[1].pose, log.scans[1].odometry), (None, Some([1.0, 2.0, 3.0])));
    }

    #[test]
    fn faults_name_the_line_and_the_field() {
        let good = flaser("1 2 3 4", "0 0 0 0 0 0", "1");
        for (bad, expected) in [
            (flaser("1 nan 3 4", "0 0 0 0 0 0", "2"), "reading 1: \"nan\""),
            (flaser("1 2 inf 4", "0 0 0 0 0 0", "2"), "reading 2: \"inf\""),
            (flaser("1 2 3 -4", "0 0 0 0 0 0", "2"), "reading 3: -4 is negative"),
            (flaser("1 2 3 x", "0 0 0 0 0 0", "2"), "reading 3: \"x\""),
            (flaser("1 2 3 4", "0 NaN 0 0 0 0", "2"), "y: \"NaN\""),
            (flaser("1 2 3 4", "0 0 0 1e9 0 0", "2"), "odom_x: 1000000000 is more than"),
            (flaser("1 2 3 4", "0 0 0 0 0 0", "later"), "ipc_time"),
            (flaser("1 2 3", "0 0 0 0 0 0", "2"), "14 fields where 15 are needed"),
            ("FLASER 3 1 2 3 0 0 0 0 0 0 2 h 2".to_owned(), "3 readings in a log of scans of 4"),
            ("FLASER 4 1 2 3 4 0 0 0 0".to_owned(), "fields"),
            ("FLASER".to_owned(), "number of readings"),
            ("FLASER 1e99".to_owned(), "not a number of beams"),
            ("FLASER -1 2".to_owned(), "not a number of beams"),
            ("3.5 4.5".to_owned(), "no kind of record"),
        ] {
            let error = read_text(&format!("# a comment\n{good}\n{bad}\n{good}")).unwrap_err();
            let error = error.to_string();
            assert!(error.contains(expected), "{error}");
            assert!(error.contains("test.log:4: "), "{error}");
            assert_eq!(error.lines().count(), 1);
        }
        assert!(matches!(read_text("ODOM 1 2 3\n"), Err(LogError::Empty { .. })));
    }

    #[test]
    fn records_without_times_are_timed_by_index() {
        let text = "FLASER 2 1 1 0 0 0 0 0 0\nFLASER 2 1 1 0 0 0 0 0 0\n";
        let log = read_text(text).unwrap();
        assert_eq!(log.scans[1].time.micros(), 1_000_000);
        assert!(log.warnings.iter().any(|note| note.contains("scan index")));
    }

    #[test]
    fn recorded_logs_are_read() {
        let Some(folder) = shared_data("carmen_corrected") else { return };
        for (file, scans, beams, no_returns, first) in [
            ("intel-corrected.log.gz", 910, 180, 4_172, [0.600266, -0.0320327, -0.354665]),
            ("freiburg-101-corrected.log.gz", 292, 360, 12_571, [0.108623, -0.0344101, 0.552197]),
            ("orebro-corrected.log.gz", 237, 181, 968, [0.255856, 0.0163473, 0.618883]),
            ("fhw-corrected.log.gz", 488, 180, 647, [1.00539, 0.140117, 0.129187]),
        ] {
            let log = super::super::read(&folder.join(file), None, Slicing::default()).unwrap();
            assert_eq!(log.format, Format::Carmen);
            assert_eq!((log.scans.len(), log.sensor.readings()), (scans, beams), "{file}");
            assert_eq!(log.scans[0].pose, Some(first), "{file}");
            assert!(log.scans.iter().all(|scan| scan.odometry.is_none()), "{file}");
            assert!(log.scans.windows(2).all(|pair| pair[0].time < pair[1].time), "{file}");
            let zeros = log.scans.iter().flat_map(|scan| &scan.readings_mm);
            let zeros = zeros.filter(|reading| **reading == 0).count();
            assert_eq!(zeros, no_returns, "{file}");
        }
    }

    #[test]
    fn raw_odometry_is_not_taken_as_poses() {
        let Some(file) = shared_data("intel_raw/intel_raw_2726.flaser.log.gz") else { return };
        let log = read_all(&[file], None, Slicing::default()).unwrap();
        assert_eq!(log.scans.len(), 2_726);
        assert!(log.scans.iter().all(|scan| scan.pose.is_none()));
        assert_eq!(log.scans[499].odometry, Some([13.525752, -7.609793, -2.279991]));
        assert!(log.warnings.iter().any(|note| note.contains("scan numbers")));
    }
}
