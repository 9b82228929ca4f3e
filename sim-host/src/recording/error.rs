//! Errors of reading recordings.

use std::path::PathBuf;

use super::format::Format;
use crate::{grid::RasterError, rounding::Rounded};

/// Why a log cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// A camera's pictures can't tell the exposure of its depths.
    #[error("{name}: --exposure needs pictures with the pixels of the depth images")]
    Exposure {
        /// The camera.
        name: String,
    },
    /// The file or folder cannot be read.
    #[error("{path}: {error}", path = path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The error of the operating system.
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
        /// The error of the decoder.
        error: std::io::Error,
    },
    /// A line is invalid.
    #[error("{path}:{line}: {fault}", path = path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// The problem.
        fault: LineFault,
    },
    /// The file or folder has none of the known formats.
    #[error(
        "{path}: empty, or not a log of a known format (CARMEN text, mines text or a folder of \
         depth images); if it is one of them, name its format with --format",
        path = path.display()
    )]
    UnknownFormat {
        /// The file or folder.
        path: PathBuf,
    },
    /// A file was given where the format needs a folder, or vice versa.
    #[error("{path}: a log of the format {format} is a {expected}", path = path.display())]
    Kind {
        /// The file or folder.
        path: PathBuf,
        /// The requested format.
        format: Format,
        /// "file" or "folder".
        expected: &'static str,
    },
    /// The file or folder lacks the records that it must contain.
    #[error("{path}: no {record} in it", path = path.display())]
    Empty {
        /// The file or folder.
        path: PathBuf,
        /// The missing record.
        record: &'static str,
    },
    /// A depth image cannot be used.
    #[error("{path}: {fault}", path = path.display())]
    Frame {
        /// The image.
        path: PathBuf,
        /// The problem.
        fault: FrameFault,
    },
    /// The number of images differs from the number of poses.
    #[error("{path}: {images} depth images but {poses} poses; give one pose for each image", path = path.display())]
    Poses {
        /// The file of the poses.
        path: PathBuf,
        /// Number of depth images in the folder.
        images: usize,
        /// Number of poses in the file.
        poses: usize,
    },
    /// The up axes of the cameras cancel out, so their mean is zero.
    #[error("{path}: the up axes of the cameras cancel out, so that the floor cannot be located; name the up axis with --up",
        path = path.display())]
    NoPlane {
        /// The file of the poses.
        path: PathBuf,
    },
    /// The intrinsics are missing, malformed or impossible.
    #[error("{path}: intrinsics: {reason}", path = path.display())]
    Intrinsics {
        /// The file of the intrinsics.
        path: PathBuf,
        /// The problem, on one line.
        reason: String,
    },
    /// The poses and the images have no time in common.
    #[error(
        "{path}: its poses are from {} to {} s, and the images from {} to {} s: no image has a pose; \
         both must be by one clock",
        poses_s[0], poses_s[1], images_s[0], images_s[1], path = path.display()
    )]
    OtherTimes {
        /// The file of the poses.
        path: PathBuf,
        /// The times of the first and the last pose.
        poses_s: [f64; 2],
        /// The times of the first and the last image.
        images_s: [f64; 2],
    },
    /// A list of images lacks one of them.
    #[error("{path}: no line in {list}; add one (TIME FILE), or remove the image",
        path = path.display(), list = list.display())]
    Unlisted {
        /// The image.
        path: PathBuf,
        /// The list.
        list: PathBuf,
    },
    /// A `cameras.toml` is malformed.
    #[error("{path}: {reason}", path = path.display())]
    Cameras {
        /// The file.
        path: PathBuf,
        /// The problem, on one line.
        reason: String,
    },
    /// Logs cannot be joined.
    #[error("{path}: its {what} differs from that of {first}; replay them one by one",
        path = path.display(), first = first.display())]
    Mixed {
        /// The log that differs.
        path: PathBuf,
        /// The first log.
        first: PathBuf,
        /// The difference.
        what: &'static str,
    },
}

/// The problem with a depth image.
#[derive(Debug, thiserror::Error)]
pub enum FrameFault {
    /// The image cannot be decoded.
    #[error("{0}")]
    Image(RasterError),
    /// The image is not 16-bit grey.
    #[error("not a depth image (16-bit grey)")]
    NotDepth,
    /// The image's size differs from the intrinsics.
    #[error(
        "{width} x {height} pixels where {expected_width} x {expected_height} are needed, as the \
         intrinsics say"
    )]
    Size {
        /// Width of the image in pixels.
        width: u32,
        /// Height of the image in pixels.
        height: u32,
        /// Width in the intrinsics.
        expected_width: u32,
        /// Height in the intrinsics.
        expected_height: u32,
    },
}

/// The problem with a line.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LineFault {
    /// The line is not UTF-8 text.
    #[error("not text (a damaged file, or another format?)")]
    NotText,
    /// The line is longer than any line of a log.
    #[error("the line is longer than {0} bytes (a damaged file, or another format?)")]
    TooLong(usize),
    /// The first word of the line is not a kind of record.
    #[error("{0:?} is no kind of record (a damaged file, or another format?)")]
    NotARecord(String),
    /// A word that should be a number is not one.
    #[error("{field}: {text:?} is not a finite number")]
    NotANumber {
        /// The field.
        field: Field,
        /// The word.
        text: String,
    },
    /// A number is out of range.
    #[error("{field}: {} is {reason}", Rounded(*.value))]
    OutOfRange {
        /// The field.
        field: Field,
        /// The value.
        value: f64,
        /// The range that it violates.
        reason: &'static str,
    },
    /// A scan differs from the others in its number of readings.
    #[error("a scan of {found} readings in a log of scans of {expected}")]
    Width {
        /// Number of readings in this scan.
        found: usize,
        /// Number of readings in the first scan.
        expected: usize,
    },
    /// The matrix or quaternion of a pose is not a rotation.
    #[error("not a rotation: {0}")]
    NoRotation(&'static str),
    /// A pose has none of the known forms.
    #[error(
        "{found} numbers; a pose is 7 (x y z qx qy qz qw), 8 (TUM: a time before them), 12 or 16 (a matrix \
         from camera to world), or 4 rows of 4"
    )]
    PoseForm {
        /// Number of numbers in this line.
        found: usize,
    },
    /// The poses of a file differ in their form.
    #[error("{found} numbers: another form of a pose than before")]
    OtherPoseForm {
        /// Number of numbers in this line.
        found: usize,
    },
    /// The camera looks at the floor or the ceiling.
    #[error(
        "the camera looks {tilt_deg:.0} degrees off the horizon; its rows cannot be mapped (or does \
         another axis point up? see --up)"
    )]
    Steep {
        /// Angle above or below the horizon, in degrees.
        tilt_deg: f64,
    },
    /// The number of fields is wrong.
    #[error("{found} fields where {expected} are needed (cut off, or another format?)")]
    Fields {
        /// Number of fields in this line.
        found: usize,
        /// Number of fields required.
        expected: usize,
    },
}

/// A numeric field of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Field {
    /// A field with a name.
    Named(&'static str),
    /// A reading of a scan, numbered from 0.
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
