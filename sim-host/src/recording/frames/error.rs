//! Errors of the playback of recorded frames.

use std::path::PathBuf;

use crate::{camera::CalibrationError, grid::RasterError, recording::error::LogError};

/// Why recorded frames cannot be played. Each error is one line.
#[derive(Debug, thiserror::Error)]
pub enum FramesError {
    /// An error in the depth images, poses or intrinsics, which have the same format as in logs.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The folder contains no camera.
    #[error(
        "{path}: no camera in it: neither here nor in a folder below is there a depth/, a color/ \
         or a pose.txt",
        path = path.display()
    )]
    NoCamera {
        /// The folder.
        path: PathBuf,
    },
    /// There are more cameras than can be played.
    #[error(
        "{path}: {cameras} cameras in all, and no more than {most} can be watched; a camera that \
         stands still has one pose, not one for each image",
        path = path.display()
    )]
    TooMany {
        /// The folder of the first camera beyond the limit.
        path: PathBuf,
        /// Number of cameras up to and including that folder.
        cameras: usize,
        /// Maximum number of cameras.
        most: usize,
    },
    /// The calibration is impossible.
    #[error("{path}: {error}", path = path.display())]
    Calibration {
        /// The folder.
        path: PathBuf,
        /// The problem.
        error: CalibrationError,
    },
    /// The camera is not above the floor.
    #[error(
        "{path}: its camera is at a height of {height_m} m; it must be above the floor: a pose is \
         that of the camera in map, with z up and the floor at 0",
        path = path.display()
    )]
    NotAboveFloor {
        /// The folder.
        path: PathBuf,
        /// Height above the floor in metres.
        height_m: f64,
    },
    /// The number of poses is neither one nor the number of frames.
    #[error("{path}: {frames} frames but {poses} poses; write one pose, or one for each frame",
        path = path.display())]
    Poses {
        /// The file of the poses.
        path: PathBuf,
        /// Number of frames in the folder.
        frames: usize,
        /// Number of poses in the file.
        poses: usize,
    },
    /// The pictures of a moving camera have poses of their own.
    #[error(
        "{path}: depth images and pictures each have a file of poses, so that there must be one \
         pose in each; leave this one out for a camera that moves",
        path = path.display()
    )]
    TwoMoving {
        /// The file of the pictures' poses.
        path: PathBuf,
    },
    /// An image cannot be read.
    #[error("{path}: {error}; remove the file to go on without it", path = path.display())]
    Damaged {
        /// The image.
        path: PathBuf,
        /// The problem.
        error: RasterError,
    },
    /// Two images of one sensor have the same number.
    #[error("{path}: has the number {number} in its name, as {other} has; number them apart",
        path = path.display(), other = other.display())]
    SameNumber {
        /// The image.
        path: PathBuf,
        /// The other one.
        other: PathBuf,
        /// The number.
        number: u128,
    },
    /// A line of the file of times is invalid.
    #[error("{path}:{line}: {reason}", path = path.display())]
    Time {
        /// The file of the times.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// The problem, and how to solve it.
        reason: String,
    },
    /// An image has no line in the file of times.
    #[error("{path}: no line in {times} for number {number}; add one, or remove the image",
        path = path.display(), times = times.display())]
    NoTime {
        /// The image.
        path: PathBuf,
        /// The file of the times.
        times: PathBuf,
        /// The number of the image.
        number: u128,
    },
    /// Some cameras have a file of times and others have none.
    #[error("{path}: missing, but {other} is there; all cameras need their times, by one clock",
        path = path.display(), other = other.display())]
    NoClock {
        /// The file that is missing.
        path: PathBuf,
        /// The file of another camera.
        other: PathBuf,
    },
    /// The times of two cameras are more than a day apart.
    #[error("{path}: begins more than a day after {other}; the times of all cameras must be by the same clock",
        path = path.display(), other = other.display())]
    OtherClock {
        /// The times of the later camera.
        path: PathBuf,
        /// The times of the first camera.
        other: PathBuf,
    },
}
