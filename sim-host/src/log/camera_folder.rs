//! The folder of one recorded camera. The form of such a folder is told in [`frames`](super::frames).

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use image::ColorType;
use nalgebra::{Isometry3, Rotation3, Translation3, UnitQuaternion};

use super::{
    FrameFault, LogError,
    frame_times::{self, FrameTime, TIMES_FILE},
    intrinsics::{self, Intrinsics},
    mounted::mounted,
    rgbd::{self, CameraPose},
};
use crate::{
    camera::{self, Calibration, CalibrationError, Lens},
    grid::{RasterError, raster},
};

/// Where the pictures are.
pub(super) const PICTURES: &str = "color";
/// What is read as a picture.
pub(super) const PICTURE_KINDS: [&str; 7] = ["png", "jpg", "jpeg", "bmp", "ppm", "pgm", "pnm"];

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

/// One sensor of a camera.
#[derive(Debug)]
pub(super) struct Sensor {
    /// Those of its images as they are on disk.
    pub(super) intrinsics: Intrinsics,
    /// Where it is: one pose, or one for each frame.
    poses: Vec<CameraPose>,
}

/// The images of one frame.
#[derive(Debug)]
pub(super) struct FrameFiles {
    pub(super) time: FrameTime,
    /// Which calibration of the folder it is of.
    pub(super) calibration: usize,
    pub(super) depth: Option<PathBuf>,
    pub(super) picture: Option<PathBuf>,
}

/// A camera's folder.
#[derive(Debug)]
pub(super) struct CameraFolder {
    pub(super) path: PathBuf,
    /// One, or one for each frame.
    pub(super) calibrations: Vec<Calibration>,
    pub(super) depth: Option<Sensor>,
    pub(super) picture: Option<Sensor>,
    /// In the order of their numbers.
    pub(super) frames: Vec<FrameFiles>,
    /// Frames that have a time, and no image.
    pub(super) lost: u64,
    /// Whether the times are those of a clock that other cameras share.
    pub(super) has_clock: bool,
    /// What the user should know.
    pub(super) notes: Vec<String>,
}

/// Depth image and picture of each frame, by number.
type Images = BTreeMap<u128, (Option<PathBuf>, Option<PathBuf>)>;

/// The folders of cameras in a folder: itself, or those below, in the order of their names.
pub(super) fn find(path: &Path) -> Result<Vec<PathBuf>, FramesError> {
    let is_camera = |path: &Path| {
        path.join("depth").is_dir() || path.join(PICTURES).is_dir() || rgbd::has_poses(path)
    };
    if is_camera(path) {
        return Ok(vec![path.to_owned()]);
    }
    let io_error = |error| LogError::Io { path: path.to_owned(), error };
    let mut found = Vec::new();
    for entry in std::fs::read_dir(path).map_err(io_error)? {
        let below = entry.map_err(io_error)?.path();
        found.extend(is_camera(&below).then_some(below));
    }
    found.sort();
    if found.is_empty() {
        return Err(FramesError::NoCamera { path: path.to_owned() });
    }
    Ok(found)
}

impl CameraFolder {
    /// Reads all of a folder but the pixels; of these it makes sure that they are as many as the
    /// intrinsics say.
    pub(super) fn open(path: &Path) -> Result<Self, FramesError> {
        let times_file = path.join(TIMES_FILE);
        // Where there are times, images that are not there were lost.
        let or_lost = |images| match images {
            Err(LogError::Empty { .. }) if times_file.is_file() => Ok(Vec::new()),
            images => images,
        };
        let pictures = path.join(PICTURES);
        let picture_files =
            if pictures.is_dir() { or_lost(picture_files(&pictures))? } else { Vec::new() };
        let depth_files = match rgbd::depth_images(path) {
            Err(LogError::Empty { path: place, .. })
                if place == path && !picture_files.is_empty() =>
            {
                Vec::new()
            }
            images => or_lost(images)?,
        };
        let has_pictures = !picture_files.is_empty();
        let images = pair(&depth_files, picture_files)?;

        let (mut notes, mut depth, mut picture) = (Vec::new(), None, None);
        if !depth_files.is_empty() {
            let (sensor, note) = Sensor::of_depth(path, images.len(), &depth_files)?;
            notes.extend(note);
            depth = Some(sensor);
        }
        if has_pictures {
            picture = Some(Sensor::of_pictures(path, &pictures, images.len(), depth.as_ref())?);
        }
        for (depth_file, picture_file) in images.values() {
            if let (Some(sensor), Some(file)) = (&depth, depth_file) {
                sensor.check(file, Some(ColorType::L16))?;
            }
            if let (Some(sensor), Some(file)) = (&picture, picture_file) {
                sensor.check(file, None)?;
            }
        }
        let calibrations = calibrations(path, images.len(), depth.as_ref(), picture.as_ref())?;

        let stated = frame_times::read(&times_file)?;
        let has_clock = stated.is_some();
        let times = stated.unwrap_or_else(|| {
            let stamps = depth.as_ref().or(picture.as_ref()).and_then(Sensor::stamps);
            let (times, note) = frame_times::by_rule(images.keys().copied(), stamps);
            notes.extend(note);
            times
        });
        if images.is_empty() {
            notes.push("no image in it: none came".to_owned());
        }
        let lost = times.keys().filter(|number| !images.contains_key(number)).count() as u64;
        let mut frames = Vec::new();
        for (index, (number, (depth, picture))) in images.into_iter().enumerate() {
            let Some(&time) = times.get(&number) else {
                let path = depth.or(picture).unwrap_or_default();
                return Err(FramesError::NoTime { path, times: times_file, number });
            };
            let calibration = index.min(calibrations.len() - 1);
            frames.push(FrameFiles { time, calibration, depth, picture });
        }
        let path = path.to_owned();
        Ok(Self { path, calibrations, depth, picture, frames, lost, has_clock, notes })
    }

    /// What it is called, and the frame too where each has a calibration of its own.
    pub(super) fn name(&self, calibration: usize) -> String {
        let name = self.path.file_name().unwrap_or(self.path.as_os_str()).to_string_lossy();
        if self.calibrations.len() == 1 { name.into() } else { format!("{name}#{calibration}") }
    }
}

impl Sensor {
    /// With a note where the intrinsics are a guess.
    fn of_depth(
        folder: &Path,
        frames: usize,
        images: &[PathBuf],
    ) -> Result<(Self, Option<String>), FramesError> {
        let poses = poses(folder, frames)?;
        // Only the well-known sets of images, which have a pose each, are known by their form.
        let (intrinsics, note) = if poses.len() > 1 {
            intrinsics::find(folder, images)?
        } else {
            let stated = match intrinsics::stated(folder)? {
                None => intrinsics_of_mounted(folder, &images[0])?,
                stated => stated,
            };
            (stated.ok_or_else(|| intrinsics::missing(folder))?, None)
        };
        Ok((Self { intrinsics, poses }, note))
    }

    /// What the pictures' own folder does not say is as that of the camera says.
    fn of_pictures(
        folder: &Path,
        pictures: &Path,
        frames: usize,
        depth: Option<&Self>,
    ) -> Result<Self, FramesError> {
        let own = intrinsics::stated(pictures)?;
        let of_depth = depth.map(|depth| depth.intrinsics.clone());
        let intrinsics = match own.or(of_depth) {
            Some(intrinsics) => intrinsics,
            None => intrinsics::stated(folder)?.ok_or_else(|| intrinsics::missing(pictures))?,
        };
        let poses = match depth {
            Some(depth) if rgbd::has_poses(pictures) => {
                let (path, own) = rgbd::read_poses(pictures)?;
                if own.len() != 1 || depth.poses.len() != 1 {
                    return Err(FramesError::TwoMoving { path });
                }
                own
            }
            Some(depth) => depth.poses.clone(),
            None if rgbd::has_poses(pictures) => poses(pictures, frames)?,
            None => poses(folder, frames)?,
        };
        Ok(Self { intrinsics, poses })
    }

    /// When its images were taken, if each pose says so.
    fn stamps(&self) -> Option<Vec<f64>> {
        self.poses.iter().map(|pose| pose.stamp_s).collect()
    }

    /// Whether y points up in its images.
    pub(super) fn is_upside_down(&self) -> bool {
        self.intrinsics.fy < 0.0
    }

    /// Makes sure that an image has the size of the intrinsics.
    fn check(&self, path: &Path, kind: Option<ColorType>) -> Result<(), FramesError> {
        let (size, found) = raster::look(path)
            .map_err(|error| FramesError::Damaged { path: path.to_owned(), error })?;
        let (expected_width, expected_height) = (self.intrinsics.width, self.intrinsics.height);
        let fault = if kind.is_some_and(|kind| kind != found) {
            FrameFault::NotDepth
        } else if size != (expected_width, expected_height) {
            let (width, height) = size;
            FrameFault::Size { width, height, expected_width, expected_height }
        } else {
            return Ok(());
        };
        Err(LogError::Frame { path: path.to_owned(), fault }.into())
    }

    /// As it is in a frame, whose first row is the top one.
    fn lens(&self, frame: usize) -> Result<Lens, CalibrationError> {
        let Intrinsics { width, height, fx, fy, cx, mut cy, mut distortion, .. } = self.intrinsics;
        if self.is_upside_down() {
            cy = f64::from(height) - 1.0 - cy;
            // What bends the image downwards.
            distortion[2] = -distortion[2];
        }
        let fy = fy.abs();
        let pinhole = camera::Intrinsics { width, height, fx, fy, cx, cy, distortion };
        let pose = &self.poses[frame.min(self.poses.len() - 1)];
        let turn = Rotation3::from_matrix_unchecked(pose.rotation);
        let place = Isometry3::from_parts(
            Translation3::from(pose.position),
            UnitQuaternion::from_rotation_matrix(&turn),
        );
        Lens::new(pinhole, place)
    }
}

fn picture_files(folder: &Path) -> Result<Vec<PathBuf>, LogError> {
    let files = rgbd::files_in(folder, &PICTURE_KINDS)?;
    if files.is_empty() {
        let record = "picture (.png, .jpg, .bmp, .ppm or .pgm)";
        return Err(LogError::Empty { path: folder.to_owned(), record });
    }
    Ok(files)
}

fn pair(depths: &[PathBuf], pictures: Vec<PathBuf>) -> Result<Images, FramesError> {
    let mut images = Images::new();
    let depths = depths.iter().cloned().map(|path| (path, false));
    for (path, is_picture) in depths.chain(pictures.into_iter().map(|path| (path, true))) {
        let number = rgbd::number_in(&path);
        let (depth, picture) = images.entry(number).or_default();
        let place = if is_picture { picture } else { depth };
        if let Some(other) = place.replace(path.clone()) {
            return Err(FramesError::SameNumber { path, other, number });
        }
    }
    Ok(images)
}

/// The intrinsics of a camera that a `cameras.toml` states, for depth images like this one.
fn intrinsics_of_mounted(folder: &Path, image: &Path) -> Result<Option<Intrinsics>, FramesError> {
    let Some(camera) = mounted(folder)? else { return Ok(None) };
    let ((width, height), _) = raster::look(image)
        .map_err(|error| FramesError::Damaged { path: image.to_owned(), error })?;
    Ok(camera.intrinsics(width, height).as_ref().map(Intrinsics::of))
}

/// The poses of a folder: one, or as many as frames.
fn poses(folder: &Path, frames: usize) -> Result<Vec<CameraPose>, FramesError> {
    if !rgbd::has_poses(folder)
        && let Some(pose) = mounted(folder)?.and_then(|camera| camera.pose())
    {
        let rotation = *pose.rotation.to_rotation_matrix().matrix();
        return Ok(vec![CameraPose::mounted(pose.translation.vector, rotation)]);
    }
    let (path, poses) = rgbd::read_poses(folder)?;
    if poses.len() != 1 && poses.len() != frames {
        return Err(FramesError::Poses { path, frames, poses: poses.len() });
    }
    Ok(poses)
}

fn calibrations(
    path: &Path,
    frames: usize,
    depth: Option<&Sensor>,
    picture: Option<&Sensor>,
) -> Result<Vec<Calibration>, FramesError> {
    let is_fixed = [depth, picture].into_iter().flatten().all(|sensor| sensor.poses.len() == 1);
    let calibration = |frame| {
        let lens = |sensor: Option<&Sensor>| sensor.map(|it| it.lens(frame)).transpose();
        Ok(Calibration { depth: lens(depth)?, picture: lens(picture)? })
    };
    let calibrations = (0..if is_fixed { 1 } else { frames }).map(calibration);
    let refuse = |error| FramesError::Calibration { path: path.to_owned(), error };
    let calibrations: Vec<Calibration> = calibrations.collect::<Result<_, _>>().map_err(refuse)?;
    // Whoever carries a camera about says where it was in any frame.
    if let [Calibration { depth, picture }] = &calibrations[..]
        && let Some(lens) = [depth, picture].into_iter().flatten().find(|it| it.centre().z <= 0.0)
    {
        let height_m = lens.centre().z;
        return Err(FramesError::NotAboveFloor { path: path.to_owned(), height_m });
    }
    Ok(calibrations)
}
