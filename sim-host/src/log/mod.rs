//! Readers of recorded logs: range scans or depth rows, with poses or odometry.
//!
//! [`read`] takes any of the formats and tells them apart by their content:
//!
//! | format | what | poses | odometry |
//! |---|---|---|---|
//! | [`Format::Carmen`] | `FLASER` records, plain or gzipped | where the log is corrected | where it is raw |
//! | [`Format::Mines`] | a hobby lidar and wheel encoders, plain or gzipped | none | from the ticks |
//! | [`Format::Rgbd`] | a folder of 16-bit depth images; one row of each | of the camera | none |
//!
//! [`RecordedFrames`] plays what cameras recorded as it is, image by image, and [`Recorder`] writes it.
//!
//! What a log leaves open (no time stamps, say) is settled by a documented rule, and
//! [`Log::notes`] says so.

mod camera_folder;
mod carmen;
mod frame_times;
mod frames;
mod intrinsics;
mod lines;
mod mines;
mod mounted;
mod recorder;
mod rgbd;
mod sensor;
mod slicing;
mod times;

use std::path::{Path, PathBuf};

use ubimap_protocol::time::Duration;

pub use camera_folder::FramesError;
pub use frames::RecordedFrames;
pub use recorder::Recorder;
pub use sensor::Sensor;
pub use slicing::{DepthSlice, PixelModel, Slicing};

use crate::grid::RasterError;

/// The formats that can be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// CARMEN text, `FLASER` records.
    Carmen,
    /// CoreSLAM's mine robot: 707 numbers a line.
    Mines,
    /// A folder of depth images, poses and intrinsics.
    Rgbd,
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Carmen => "carmen",
            Self::Mines => "mines",
            Self::Rgbd => "rgbd",
        })
    }
}

/// One scan of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LoggedScan {
    /// Since the first scan; later than that of the scan before.
    pub time: Duration,
    /// Millimetres, as [`Sensor`] tells; 0 where nothing came back, whatever the log's code for it.
    pub readings_mm: Vec<u16>,
    /// The sensor in `map`: x and y in metres, heading in radians.
    pub pose: Option<[f64; 3]>,
    /// The robot in `odom`: x and y in metres, heading in radians.
    pub odometry: Option<[f64; 3]>,
    /// Where it stands in its file: the line, or the number of the frame, from 1.
    pub line: usize,
}

/// A log: at least one scan, all of one sensor, all with a pose or none, all with odometry or none.
#[derive(Clone, Debug, PartialEq)]
pub struct Log {
    /// What it was read from.
    pub format: Format,
    /// What made the scans.
    pub sensor: Sensor,
    /// The scans in the order of their times.
    pub scans: Vec<LoggedScan>,
    /// What the user should know, one line each.
    pub notes: Vec<String>,
}

/// Why a log can't be read.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The file or folder can't be read.
    #[error("{path}: {error}", path = path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        error: std::io::Error,
    },
    /// The compressed data is damaged or ends too early.
    #[error("{path}:{line}: the gzip data is damaged or cut off after this line ({error})",
        path = path.display())]
    Gzip {
        /// The file.
        path: PathBuf,
        /// The last line that could be read.
        line: usize,
        /// What the decoder says.
        error: std::io::Error,
    },
    /// A line that can't be right.
    #[error("{path}:{line}: {fault}", path = path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        fault: LineFault,
    },
    /// None of the formats.
    #[error(
        "{path}: not a log of a known format (CARMEN text, mines text or a folder of depth \
         images); if it is one, name it with --format",
        path = path.display()
    )]
    UnknownFormat {
        /// The file or folder.
        path: PathBuf,
    },
    /// A file where a folder is needed, or the other way round.
    #[error("{path}: a log of the format {format} is a {expected}", path = path.display())]
    Kind {
        /// The file or folder.
        path: PathBuf,
        /// The format that was asked for.
        format: Format,
        /// "file" or "folder".
        expected: &'static str,
    },
    /// A log of the right form without a scan in it.
    #[error("{path}: no {record} in it", path = path.display())]
    Empty {
        /// The file or folder.
        path: PathBuf,
        /// What was looked for.
        record: &'static str,
    },
    /// An image that can't be sliced.
    #[error("{path}: {fault}", path = path.display())]
    Frame {
        /// The image.
        path: PathBuf,
        /// What is wrong with it.
        fault: FrameFault,
    },
    /// Not one pose for each image.
    #[error("{path}: {images} depth images but {poses} poses", path = path.display())]
    Poses {
        /// The file of the poses.
        path: PathBuf,
        /// Depth images in the folder.
        images: usize,
        /// Poses in the file.
        poses: usize,
    },
    /// Cameras that don't agree on which way is up.
    #[error("{path}: the up axes of the cameras cancel out; no telling where the floor is",
        path = path.display())]
    NoPlane {
        /// The file of the poses.
        path: PathBuf,
    },
    /// Intrinsics that are missing, damaged or impossible.
    #[error("{path}: intrinsics: {reason}", path = path.display())]
    Intrinsics {
        /// The file of the intrinsics.
        path: PathBuf,
        /// What is wrong, on one line.
        reason: String,
    },
    /// A file of placed cameras that can't be read.
    #[error("{path}: {reason}", path = path.display())]
    Cameras {
        /// The file.
        path: PathBuf,
        /// What is wrong, on one line.
        reason: String,
    },
    /// Logs that can't be joined.
    #[error("{path}: its {what} differs from that of {first}; replay them one by one",
        path = path.display(), first = first.display())]
    Mixed {
        /// The log that doesn't fit.
        path: PathBuf,
        /// The first one.
        first: PathBuf,
        /// What differs.
        what: &'static str,
    },
}

/// What is wrong with a depth image.
#[derive(Debug, thiserror::Error)]
pub enum FrameFault {
    /// It can't be decoded.
    #[error("{0}")]
    Image(RasterError),
    /// It is no image of depths.
    #[error("not a depth image (16-bit grey)")]
    NotDepth,
    /// Not of the size that the intrinsics are for.
    #[error(
        "{width} x {height} pixels where {expected_width} x {expected_height} are needed, as the \
         intrinsics say"
    )]
    Size {
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
        /// Pixels in a row, by the intrinsics.
        expected_width: u32,
        /// Rows, by the intrinsics.
        expected_height: u32,
    },
}

/// What is wrong with a line.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LineFault {
    /// Bytes that are no text.
    #[error("not text (a damaged file, or another format?)")]
    NotText,
    /// A line longer than any that a log has.
    #[error("the line is longer than {0} bytes (a damaged file, or another format?)")]
    TooLong(usize),
    /// A line that begins with no word where records begin with their kind.
    #[error("{0:?} is no kind of record (a damaged file, or another format?)")]
    NotARecord(String),
    /// A word where a number should be.
    #[error("{field}: {text:?} is not a finite number")]
    NotANumber {
        /// Which number.
        field: Field,
        /// The word.
        text: String,
    },
    /// A number that can't be.
    #[error("{field}: {value} is {reason}")]
    OutOfRange {
        /// Which number.
        field: Field,
        /// The number.
        value: f64,
        /// Why it can't be.
        reason: &'static str,
    },
    /// A scan that is not like the others.
    #[error("a scan of {found} readings in a log of scans of {expected}")]
    Width {
        /// Readings in this scan.
        found: usize,
        /// Readings in the first scan.
        expected: usize,
    },
    /// A pose whose matrix or quaternion is not a rotation.
    #[error("not a rotation")]
    NoRotation,
    /// A camera that looks at the floor or the ceiling.
    #[error("the camera looks {tilt_deg:.0} degrees off the horizon; its rows draw no map")]
    Steep {
        /// Degrees above or below the horizon.
        tilt_deg: f64,
    },
    /// Not as many fields as the record has.
    #[error("{found} fields where {expected} are needed (cut off, or another format?)")]
    Fields {
        /// Fields in this line.
        found: usize,
        /// Fields that it should have.
        expected: usize,
    },
}

/// Which number of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Field {
    /// One with a name.
    Named(&'static str),
    /// A reading of a scan, from 0.
    Reading(usize),
}

impl std::fmt::Display for Field {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Named(name) => f.write_str(name),
            Self::Reading(index) => write!(f, "reading {index}"),
        }
    }
}

/// Reads a log; `None` tells the format by the content: a folder holds depth images, a file that
/// begins with a word is CARMEN text, one that begins with a number comes from the mines. Depth
/// images are sliced as `slicing` says.
pub fn read(path: &Path, format: Option<Format>, slicing: Slicing) -> Result<Log, LogError> {
    let is_folder = std::fs::metadata(path)
        .map_err(|error| LogError::Io { path: path.to_owned(), error })?
        .is_dir();
    let format = match format {
        Some(format) => format,
        None if is_folder => Format::Rgbd,
        None => detect(path)?,
    };
    if is_folder != (format == Format::Rgbd) {
        let expected = if is_folder { "file" } else { "folder" };
        return Err(LogError::Kind { path: path.to_owned(), format, expected });
    }
    match format {
        Format::Carmen => carmen::read(path),
        Format::Mines => mines::read(path),
        Format::Rgbd => rgbd::read(path, slicing),
    }
}

/// Reads several logs of one sensor and joins them; see [`concatenate`].
pub fn read_all(
    paths: &[PathBuf],
    format: Option<Format>,
    slicing: Slicing,
) -> Result<Log, LogError> {
    let logs: Result<Vec<_>, _> =
        paths.iter().map(|path| Ok((path.clone(), read(path, format, slicing)?))).collect();
    concatenate(logs?)
}

/// Joins logs of one sensor, each under the path that errors name, into one. Each goes on where the
/// one before ended: in time, and in odometry, whose frames have nothing else in common.
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
            return Err(mixed("kind of poses (corrected or odometry alone)"));
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
        joined.notes.push("odometry goes on from where the log before ended".to_owned());
    }
    joined.scans.extend(log.scans.into_iter().map(|mut scan| {
        scan.time = start + scan.time;
        scan.odometry = scan.odometry.map(|pose| match odometry_shift {
            Some((end, begin)) => compose(end, relative(begin, pose)),
            None => pose,
        });
        scan
    }));
    joined.notes.extend(log.notes);
}

/// The pose `to` seen from the pose `from`.
fn relative(from: [f64; 3], to: [f64; 3]) -> [f64; 3] {
    let (sin, cos) = from[2].sin_cos();
    let (x, y) = (to[0] - from[0], to[1] - from[1]);
    [x * cos + y * sin, y * cos - x * sin, to[2] - from[2]]
}

/// The pose that lies at `step`, seen from `from`.
fn compose(from: [f64; 3], step: [f64; 3]) -> [f64; 3] {
    let (sin, cos) = from[2].sin_cos();
    let [x, y, turn] = step;
    [from[0] + x * cos - y * sin, from[1] + x * sin + y * cos, from[2] + turn]
}

/// Tells a text format by the first word of the first line that has one and is no comment.
fn detect(path: &Path) -> Result<Format, LogError> {
    let mut lines = lines::Lines::open(path)?;
    let unknown = || LogError::UnknownFormat { path: path.to_owned() };
    while let Some(line) = lines.next() {
        let text = match line {
            Ok((_, text)) => text,
            // What is no text is no log, however far one gets with it.
            Err(LogError::Line { .. }) => return Err(unknown()),
            Err(error) => return Err(error),
        };
        let Some(word) = text.split_ascii_whitespace().next() else { continue };
        if word.starts_with('#') {
            continue;
        }
        return if word.parse::<f64>().is_ok_and(f64::is_finite) {
            Ok(Format::Mines)
        } else if carmen::is_record_kind(word) {
            Ok(Format::Carmen)
        } else {
            Err(unknown())
        };
    }
    Err(unknown())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::testing::Folder;

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
        Log { format: Format::Mines, sensor, scans, notes: Vec::new() }
    }

    #[test]
    fn joined_logs_go_on_in_time_and_odometry() {
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

    #[test]
    fn formats_are_told_by_content() {
        let folder = Folder::new("log-detect");
        for (bytes, format) in [
            (&b"# c\n\nPARAM x 1 h 0\nFLASER"[..], Some(Format::Carmen)),
            (b"1234 5 6", Some(Format::Mines)),
            (b"\x89PNG\r\n", None),
            (b"{\"a\": 1}", None),
            (b"", None),
        ] {
            let path = folder.file("some.log", bytes);
            match format {
                Some(format) => assert_eq!(detect(&path).unwrap(), format),
                None => assert!(matches!(
                    read(&path, None, Slicing::default()),
                    Err(LogError::UnknownFormat { .. })
                )),
            }
        }
        let carmen_as_folder =
            read(folder.path(), Some(Format::Carmen), Slicing::default()).unwrap_err();
        assert!(carmen_as_folder.to_string().ends_with("a log of the format carmen is a file"));
        assert!(matches!(
            read(&folder.path().join("none"), None, Slicing::default()),
            Err(LogError::Io { .. })
        ));
    }

    #[test]
    fn a_cut_off_gzip_names_the_last_line() {
        use std::io::Write;
        let line = "FLASER 2 1 1 0 0 0 0 0 0\n";
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::none());
        encoder.write_all(line.repeat(100).as_bytes()).unwrap();
        let bytes = encoder.finish().unwrap();
        let folder = Folder::new("log-gzip");
        assert_eq!(
            read(&folder.file("whole.gz", &bytes), None, Slicing::default()).unwrap().scans.len(),
            100
        );
        let cut = read(&folder.file("cut.gz", &bytes[..bytes.len() - 9]), None, Slicing::default())
            .unwrap_err();
        assert!(matches!(cut, LogError::Gzip { line: 99.., .. }), "{cut}");
        assert!(cut.to_string().contains("cut.gz:"));
        let mut damaged = bytes.clone();
        damaged[500] ^= 0x01;
        assert!(read(&folder.file("damaged.gz", &damaged), None, Slicing::default()).is_err());
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        /// Whatever is in a file, reading it ends with a log or with one line.
        #[test]
        fn garbled_files_never_panic(
            at in any::<prop::sample::Index>(),
            byte in any::<u8>(),
            length in any::<prop::sample::Index>(),
            format in prop::sample::select(vec![Format::Carmen, Format::Mines]),
        ) {
            let folder = Folder::new(&format!("log-garbled-{format}"));
            let mut bytes = match format {
                Format::Mines => {
                    let mut line = vec!["1"; 707].join(" ");
                    line.push('\n');
                    line.repeat(3).into_bytes()
                }
                _ => b"PARAM robot_front_laser_max 80 h 0\n\
                       FLASER 3 1.5 81.83 0.2 1 2 3 1 2 3 0.5 h 0.5\n\
                       FLASER 3 1.5 81.83 0.2 1 2 3 1 2 3 0.7 h 0.7\n".to_vec(),
            };
            let at = at.index(bytes.len());
            bytes[at] = byte;
            bytes.truncate(length.index(bytes.len() + 1));
            for format in [Some(format), None] {
                match read(&folder.file("garbled.log", &bytes), format, Slicing::default()) {
                    Ok(log) => prop_assert!(!log.scans.is_empty()),
                    Err(error) => prop_assert_eq!(error.to_string().lines().count(), 1),
                }
            }
        }
    }
}
