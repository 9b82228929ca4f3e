//! Why a recording can't be read.

use std::path::PathBuf;

use super::format::Format;
use crate::grid::RasterError;

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
    /// A `cameras.toml` that can't be read.
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
