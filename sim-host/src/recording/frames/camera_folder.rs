//! The folder of one recorded camera; [`frames`](super) describes its layout.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use image::ColorType;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

use super::{
    error::FramesError,
    frame_times::{self, FrameTime, FrameTimes, TIMES_FILE},
};
use crate::{
    camera::{self, Calibration, CalibrationError, DepthNoise, Lens},
    grid::raster,
    recording::{
        camera_poses::{CameraPose, has_poses, read_poses},
        error::{FrameFault, LogError},
        intrinsics::{self, IntrinsicsFile},
        mounted::mounted,
        numbered_files::{PICTURE_KINDS, depth_images, files_in, number_in},
    },
};

/// The folder of a camera's pictures.
pub(super) const PICTURES: &str = "color";

/// The intrinsics and poses of one sensor of a camera, as stated in the files.
#[derive(Debug)]
pub(super) struct SensorFiles {
    /// Intrinsics of the images on disk.
    pub(super) intrinsics: IntrinsicsFile,
    /// One pose for all frames, or one per frame.
    poses: Vec<CameraPose>,
}

/// The image files of one frame.
#[derive(Debug)]
pub(super) struct FrameFiles {
    pub(super) time: FrameTime,
    /// Index into [`CameraFolder::calibrations`].
    pub(super) calibration: usize,
    pub(super) depth: Option<PathBuf>,
    pub(super) picture: Option<PathBuf>,
}

/// A camera's folder.
#[derive(Debug)]
pub(super) struct CameraFolder {
    pub(super) path: PathBuf,
    /// One calibration for all frames, or one per frame.
    pub(super) calibrations: Vec<Calibration>,
    pub(super) depth: Option<SensorFiles>,
    pub(super) picture: Option<SensorFiles>,
    /// The frames in the order of their numbers.
    pub(super) frames: Vec<FrameFiles>,
    /// Number of frames with a time but without an image.
    pub(super) lost: u64,
    /// Whether its pose is stated.
    pub(super) is_placed: bool,
    /// Whether the times come from a clock shared with other cameras.
    pub(super) has_clock: bool,
    /// Notes for the user, one line each.
    pub(super) notes: Vec<String>,
}

/// Whether the poses of cameras must be stated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Placing {
    /// Each folder, or `cameras.toml`, states the pose.
    Stated,
    /// A camera whose pose is not stated gets [`NOWHERE`].
    Optional,
}

/// The pose of a camera that has none: one metre above the origin, looking along z.
const NOWHERE: [f64; 3] = [0.0, 0.0, 1.0];

/// The depth image and the picture of each frame, by number.
type Images = BTreeMap<u128, (Option<PathBuf>, Option<PathBuf>)>;

/// The camera folders in a folder: the folder itself if it is one, otherwise its subfolders in the
/// order of their names.
pub(super) fn find(path: &Path) -> Result<Vec<PathBuf>, FramesError> {
    let is_camera = |path: &Path| {
        path.join("depth").is_dir() || path.join(PICTURES).is_dir() || has_poses(path)
    };
    if is_camera(path) {
        return Ok(vec![path.to_owned()]);
    }
    let io_error = |error| LogError::Io { path: path.to_owned(), error };
    if path.is_file() {
        let expected = "a file, where a folder with camera frames is expected";
        return Err(io_error(std::io::Error::other(expected)).into());
    }
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
    /// Reads everything except the pixels, and checks that the images have the size stated in the
    /// intrinsics.
    pub(super) fn open(path: &Path, placing: Placing) -> Result<Self, FramesError> {
        let times_file = path.join(TIMES_FILE);
        let (depth_files, picture_files) = image_files(path, times_file.is_file())?;
        let has_pictures = !picture_files.is_empty();
        let images = pair(&depth_files, picture_files)?;

        let (mut notes, mut depth, mut picture) = (Vec::new(), None, None);
        if !depth_files.is_empty() {
            depth = Some(SensorFiles::of_depth(path, placing, images.len(), &depth_files)?);
        }
        if has_pictures {
            picture = Some(SensorFiles::of_pictures(path, placing, images.len(), depth.as_ref())?);
        }
        check_sizes(&images, depth.as_ref(), picture.as_ref())?;
        let calibrations = calibrations(path, images.len(), depth.as_ref(), picture.as_ref())?;

        let stated = frame_times::read(&times_file)?;
        let has_clock = stated.is_some();
        let times = stated.unwrap_or_else(|| {
            let stamps = depth.as_ref().or(picture.as_ref()).and_then(SensorFiles::stamps);
            let (times, note) = frame_times::by_rule(images.keys().copied(), stamps);
            notes.extend(note);
            times
        });
        if images.is_empty() {
            notes.push("no image in it: all its frames were lost".to_owned());
        }
        let is_placed =
            has_poses(path) || has_poses(&path.join(PICTURES)) || mounted(path)?.is_some();
        let lost = times.keys().filter(|number| !images.contains_key(number)).count() as u64;
        let frames = frames(images, &times, &times_file, calibrations.len())?;
        let path = path.to_owned();
        Ok(Self { path, calibrations, depth, picture, frames, lost, is_placed, has_clock, notes })
    }

    /// The camera's name, followed by the index of the calibration if each frame has its own.
    pub(super) fn name(&self, calibration: usize) -> String {
        let name = self.path.file_name().unwrap_or(self.path.as_os_str()).to_string_lossy();
        if self.calibrations.len() == 1 { name.into() } else { format!("{name}#{calibration}") }
    }
}

impl SensorFiles {
    /// The files of the depth sensor.
    fn of_depth(
        folder: &Path,
        placing: Placing,
        frames: usize,
        images: &[PathBuf],
    ) -> Result<Self, FramesError> {
        let poses = poses(folder, placing, frames)?;
        let stated = match intrinsics::stated(folder)? {
            // `cameras.toml` describes only fixed cameras.
            None if poses.len() == 1 => mounted_intrinsics(folder, &images[0])?,
            stated => stated,
        };
        let intrinsics = stated.ok_or_else(|| intrinsics::missing(folder))?;
        Ok(Self { intrinsics, poses })
    }

    /// The files of the picture sensor. For missing files, those of the depth sensor are used.
    fn of_pictures(
        folder: &Path,
        placing: Placing,
        frames: usize,
        depth: Option<&Self>,
    ) -> Result<Self, FramesError> {
        let pictures = &folder.join(PICTURES);
        let own = intrinsics::stated(pictures)?;
        let of_depth = depth.map(|depth| depth.intrinsics.clone());
        let intrinsics = match own.or(of_depth) {
            Some(intrinsics) => intrinsics,
            None => intrinsics::stated(folder)?.ok_or_else(|| intrinsics::missing(pictures))?,
        };
        let poses = match depth {
            Some(depth) if has_poses(pictures) => {
                let (path, own) = read_poses(pictures)?;
                if own.len() != 1 || depth.poses.len() != 1 {
                    return Err(FramesError::TwoMoving { path });
                }
                own
            }
            Some(depth) => depth.poses.clone(),
            None if has_poses(pictures) => poses(pictures, placing, frames)?,
            None => poses(folder, placing, frames)?,
        };
        Ok(Self { intrinsics, poses })
    }

    /// The capture times, if each pose has a time stamp.
    fn stamps(&self) -> Option<Vec<f64>> {
        self.poses.iter().map(|pose| pose.stamp_s).collect()
    }

    /// Whether the y axis of its images points up.
    pub(super) fn is_upside_down(&self) -> bool {
        self.intrinsics.fy < 0.0
    }

    /// Checks that an image has the size stated in the intrinsics, and the colour type `kind`, if
    /// any.
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

    /// The lens of the sensor at a frame, for images whose first row is the top one.
    fn lens(&self, frame: usize) -> Result<Lens, CalibrationError> {
        let IntrinsicsFile { width, height, fx, fy, cx, mut cy, mut distortion, .. } =
            self.intrinsics;
        if self.is_upside_down() {
            cy = f64::from(height) - 1.0 - cy;
            // The tangential distortion p1 acts along the flipped axis.
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

/// The depth images and pictures in a camera's folder. With a file of times, there may be no
/// images: then all frames were lost.
fn image_files(
    folder: &Path,
    has_times: bool,
) -> Result<(Vec<PathBuf>, Vec<PathBuf>), FramesError> {
    let or_lost = |images| match images {
        Err(LogError::Empty { .. }) if has_times => Ok(Vec::new()),
        images => images,
    };
    let pictures = folder.join(PICTURES);
    let pictures = if pictures.is_dir() { or_lost(picture_files(&pictures))? } else { Vec::new() };
    let depths = match depth_images(folder) {
        // The camera has no depth sensor.
        Err(LogError::Empty { path, .. }) if path == folder && !pictures.is_empty() => Vec::new(),
        images => or_lost(images)?,
    };
    Ok((depths, pictures))
}

fn picture_files(folder: &Path) -> Result<Vec<PathBuf>, LogError> {
    let files = files_in(folder, &PICTURE_KINDS)?;
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
        let number = number_in(&path);
        let (depth, picture) = images.entry(number).or_default();
        let place = if is_picture { picture } else { depth };
        if let Some(other) = place.replace(path.clone()) {
            return Err(FramesError::SameNumber { path, other, number });
        }
    }
    Ok(images)
}

/// Checks that all images have the size stated in their sensor's intrinsics.
fn check_sizes(
    images: &Images,
    depth: Option<&SensorFiles>,
    picture: Option<&SensorFiles>,
) -> Result<(), FramesError> {
    for (depth_file, picture_file) in images.values() {
        if let (Some(sensor), Some(file)) = (depth, depth_file) {
            sensor.check(file, Some(ColorType::L16))?;
        }
        if let (Some(sensor), Some(file)) = (picture, picture_file) {
            sensor.check(file, None)?;
        }
    }
    Ok(())
}

/// The frames with their times, in the order of their numbers.
fn frames(
    images: Images,
    times: &FrameTimes,
    times_file: &Path,
    calibrations: usize,
) -> Result<Vec<FrameFiles>, FramesError> {
    let frame = |(index, (number, (depth, picture))): (usize, (u128, _))| {
        let calibration = index.min(calibrations - 1);
        match times.get(&number) {
            Some(&time) => Ok(FrameFiles { time, calibration, depth, picture }),
            None => {
                let path = Option::or(depth, picture).unwrap_or_default();
                Err(FramesError::NoTime { path, times: times_file.to_owned(), number })
            }
        }
    };
    images.into_iter().enumerate().map(frame).collect()
}

/// The intrinsics that a `cameras.toml` states for this folder, scaled to the size of `image`.
/// `None` if it states none.
fn mounted_intrinsics(folder: &Path, image: &Path) -> Result<Option<IntrinsicsFile>, FramesError> {
    let Some(camera) = mounted(folder)? else { return Ok(None) };
    let ((width, height), _) = raster::look(image)
        .map_err(|error| FramesError::Damaged { path: image.to_owned(), error })?;
    Ok(camera.intrinsics(width, height).map(|pinhole| IntrinsicsFile::of(&pinhole, None)))
}

/// The poses in a folder: one, or one for each frame.
fn poses(folder: &Path, placing: Placing, frames: usize) -> Result<Vec<CameraPose>, FramesError> {
    if !has_poses(folder) {
        if let Some(pose) = mounted(folder)?.and_then(|camera| camera.pose()) {
            let rotation = *pose.rotation.to_rotation_matrix().matrix();
            return Ok(vec![CameraPose::mounted(pose.translation.vector, rotation)]);
        }
        // Without the depth sensor's pose, that of the pictures says nothing.
        if placing == Placing::Optional && !has_poses(&folder.join(PICTURES)) {
            return Ok(vec![CameraPose::mounted(NOWHERE.into(), Matrix3::identity())]);
        }
    }
    let (path, poses) = read_poses(folder)?;
    if poses.len() != 1 && poses.len() != frames {
        return Err(FramesError::Poses { path, frames, poses: poses.len() });
    }
    Ok(poses)
}

fn calibrations(
    path: &Path,
    frames: usize,
    depth: Option<&SensorFiles>,
    picture: Option<&SensorFiles>,
) -> Result<Vec<Calibration>, FramesError> {
    let is_fixed = [depth, picture].into_iter().flatten().all(|sensor| sensor.poses.len() == 1);
    let calibration = |frame| {
        let lens = |sensor: Option<&SensorFiles>| sensor.map(|it| it.lens(frame)).transpose();
        let depth_noise =
            depth.map_or(Ok(DepthNoise::default()), |depth| depth.intrinsics.noise())?;
        Ok(Calibration { depth: lens(depth)?, depth_noise, picture: lens(picture)? })
    };
    let calibrations = (0..if is_fixed { 1 } else { frames }).map(calibration);
    let refuse = |error| FramesError::Calibration { path: path.to_owned(), error };
    let calibrations: Vec<Calibration> = calibrations.collect::<Result<_, _>>().map_err(refuse)?;
    // With one pose per frame the camera moves, so its height need not be checked.
    if let [Calibration { depth, picture, .. }] = &calibrations[..]
        && let Some(lens) = [depth, picture].into_iter().flatten().find(|it| it.centre().z <= 0.0)
    {
        let height_m = lens.centre().z;
        return Err(FramesError::NotAboveFloor { path: path.to_owned(), height_m });
    }
    Ok(calibrations)
}
