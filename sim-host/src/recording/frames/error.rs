//! Why recorded frames can't be played.

use std::path::PathBuf;

use crate::{camera::CalibrationError, grid::RasterError, recording::error::LogError};

/// Why recorded frames can't be watched. Each is one line.
#[derive(Debug, thiserror::Error)]
pub enum FramesError {
    /// What depth images, poses and intrinsics share with logs.
    #[error(transparent)]
    Log(#[from] LogError),
    /// No camera is recorded there.
    #[error(
        "{path}: no camera in it: neither here nor in a folder below is there a depth/, a color/ \
         or a pose.txt",
        path = path.display()
    )]
    NoCamera {
        /// The folder.
        path: PathBuf,
    },
    /// More cameras than any room has.
    #[error(
        "{path}: {cameras} cameras in all, and no more than {most} can be watched; a camera that \
         stands still has one pose, not one for each image",
        path = path.display()
    )]
    TooMany {
        /// The folder of the camera with which they are too many.
        path: PathBuf,
        /// Cameras so far.
        cameras: usize,
        /// Those that can be watched.
        most: usize,
    },
    /// No camera can be like that.
    #[error("{path}: {error}", path = path.display())]
    Calibration {
        /// The folder.
        path: PathBuf,
        /// Why not.
        error: CalibrationError,
    },
    /// A camera on the floor or below it.
    #[error(
        "{path}: its camera is at a height of {height_m} m; it must be above the floor: a pose is \
         that of the camera in map, with z up and the floor at 0",
        path = path.display()
    )]
    NotAboveFloor {
        /// The folder.
        path: PathBuf,
        /// Above the floor.
        height_m: f64,
    },
    /// Not one pose, nor one for each frame.
    #[error("{path}: {frames} frames but {poses} poses; write one pose, or one for each frame",
        path = path.display())]
    Poses {
        /// The file of the poses.
        path: PathBuf,
        /// Frames in the folder.
        frames: usize,
        /// Poses in the file.
        poses: usize,
    },
    /// Pictures with a pose of their own, of a camera that moves.
    #[error(
        "{path}: depth images and pictures each have a file of poses, so that there must be one \
         pose in each; leave this one out for a camera that moves",
        path = path.display()
    )]
    TwoMoving {
        /// The file of the pictures' poses.
        path: PathBuf,
    },
    /// An image that can't be read.
    #[error("{path}: {error}; remove the file to go on without it", path = path.display())]
    Damaged {
        /// The image.
        path: PathBuf,
        /// What is wrong with it.
        error: RasterError,
    },
    /// Two images of one sensor with one number.
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
    /// A line of the times that can't be right.
    #[error("{path}:{line}: {reason}", path = path.display())]
    Time {
        /// The file of the times.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it, and what it should be.
        reason: String,
    },
    /// An image without a time where others have one.
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
    /// Some cameras have times and some have not.
    #[error("{path}: missing, but {other} is there; all cameras need their times, by one clock",
        path = path.display(), other = other.display())]
    NoClock {
        /// The file that is missing.
        path: PathBuf,
        /// The file of another camera.
        other: PathBuf,
    },
    /// Cameras whose times have nothing to do with each other.
    #[error("{path}: begins more than a day after {other}; all cameras need one clock",
        path = path.display(), other = other.display())]
    OtherClock {
        /// The file of the camera that is late.
        path: PathBuf,
        /// The file of the first camera.
        other: PathBuf,
    },
}
