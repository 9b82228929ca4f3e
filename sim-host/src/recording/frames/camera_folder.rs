//! The folder of one recorded camera; [`frames`](super) describes its layout.

use std::path::{Path, PathBuf};

use image::ColorType;
use nalgebra::{Isometry3, Matrix3, Translation3};

use super::{
    error::FramesError,
    frame_times::{self, FrameTime, FrameTimes, TIMES_FILE},
    images::{FrameImages, Images, pictures_in},
};
use crate::{
    camera::{self, Calibration, CalibrationError, DepthNoise, Lens},
    grid::raster,
    recording::{
        camera_pose::CameraPose,
        camera_poses::{at_times, has_poses, is_still, read_poses},
        error::{FrameFault, LogError},
        intrinsics::{self, IntrinsicsFile},
        mounted::mounted,
    },
};

/// The intrinsics and poses of one sensor of a camera, as stated in the files.
#[derive(Debug)]
pub(super) struct SensorFiles {
    /// Intrinsics of the images on disk.
    pub(super) intrinsics: IntrinsicsFile,
    /// One pose for all frames, or one per frame.
    poses: Vec<CameraPose>,
}

/// The files of one frame.
#[derive(Debug)]
pub(super) struct FrameFiles {
    pub(super) time: FrameTime,
    /// Index into [`CameraFolder::calibrations`].
    pub(super) calibration: usize,
    pub(super) images: FrameImages,
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

/// How recorded frames are read.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reading {
    /// Whether cameras may lack a stated pose, in their folders and in `cameras.toml`. They are then all at
    /// one pose.
    pub may_lack_poses: bool,
    /// Units of the depth images per metre, instead of what the intrinsics state.
    pub depth_per_metre: Option<f64>,
}

impl Reading {
    /// Cameras may lack a stated pose.
    pub const UNPLACED: Self = Self { may_lack_poses: true, depth_per_metre: None };
}

/// The pose of a camera that has none: one metre above the origin, looking along z.
const NOWHERE: [f64; 3] = [0.0, 0.0, 1.0];

/// The camera folders in a folder: the folder itself if it is one, otherwise its subfolders in the
/// order of their names.
pub(super) fn find(path: &Path) -> Result<Vec<PathBuf>, FramesError> {
    let is_camera =
        |path: &Path| path.join("depth").is_dir() || pictures_in(path).is_dir() || has_poses(path);
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
    pub(super) fn open(path: &Path, reading: Reading) -> Result<Self, FramesError> {
        let mut images = Images::find(path)?;
        let stated = frame_times::read(&path.join(TIMES_FILE))?;
        let mut notes = Vec::new();
        let timed = timed_poses(path, &mut images, stated.as_ref(), &mut notes)?;
        let wanted = Wanted { folder: path, reading, frames: images.frames.len(), timed };

        let (mut depth, mut picture) = (None, None);
        let [first_depth, first_picture] = images.first();
        if let Some(image) = first_depth {
            depth = Some(SensorFiles::of_depth(&wanted, image)?);
        }
        if first_picture.is_some() {
            picture = Some(SensorFiles::of_pictures(&wanted, depth.as_ref())?);
        }
        check_sizes(&images, depth.as_ref(), picture.as_ref())?;
        let calibrations = calibrations(path, wanted.frames, depth.as_ref(), picture.as_ref())?;

        let stated = stated.or(images.times.take());
        let has_clock = stated.is_some();
        let times = stated.unwrap_or_else(|| {
            let stamps = depth.as_ref().or(picture.as_ref()).and_then(SensorFiles::stamps);
            let (times, note) = frame_times::by_rule(images.frames.keys().copied(), stamps);
            notes.extend(note);
            times
        });
        if images.frames.is_empty() {
            notes.push("no image in it: all its frames were lost".to_owned());
        }
        let is_placed =
            has_poses(path) || has_poses(&pictures_in(path)) || mounted(path)?.is_some();
        let lost = times.keys().filter(|it| !images.frames.contains_key(it)).count() as u64;
        let frames = frames(images, &times, calibrations.len())?;
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
    /// The files of the depth sensor, of which `image` is one image.
    fn of_depth(wanted: &Wanted<'_>, image: &Path) -> Result<Self, FramesError> {
        let folder = wanted.folder;
        let poses = wanted.poses(folder)?;
        let stated = match intrinsics::stated(folder, wanted.reading.depth_per_metre)? {
            // `cameras.toml` describes only fixed cameras.
            None if poses.len() == 1 => mounted_intrinsics(wanted, image)?,
            stated => stated,
        };
        let intrinsics = stated.ok_or_else(|| intrinsics::missing(folder))?;
        Ok(Self { intrinsics, poses })
    }

    /// The files of the picture sensor. For missing files, those of the depth sensor are used.
    fn of_pictures(wanted: &Wanted<'_>, depth: Option<&Self>) -> Result<Self, FramesError> {
        let Wanted { folder, reading, .. } = *wanted;
        let pictures = &pictures_in(folder);
        // Pictures have no depths, whose scale would be needed.
        let scale = reading.depth_per_metre.or(Some(1000.0));
        let own = intrinsics::stated(pictures, scale)?;
        let of_depth = depth.map(|depth| depth.intrinsics.clone());
        let intrinsics = match own.or(of_depth) {
            Some(intrinsics) => intrinsics,
            None => {
                let stated = intrinsics::stated(folder, scale)?;
                stated.ok_or_else(|| intrinsics::missing(pictures))?
            }
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
            None if has_poses(pictures) => wanted.poses(pictures)?,
            None => wanted.poses(folder)?,
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
        let place = Isometry3::from_parts(Translation3::from(pose.position), pose.turn());
        Lens::new(pinhole, place)
    }
}

/// Checks that all images have the size stated in their sensor's intrinsics.
fn check_sizes(
    images: &Images,
    depth: Option<&SensorFiles>,
    picture: Option<&SensorFiles>,
) -> Result<(), FramesError> {
    for frame in images.frames.values() {
        if let (Some(sensor), Some(file)) = (depth, &frame.depth) {
            sensor.check(file, Some(ColorType::L16))?;
        }
        if let (Some(sensor), Some(file)) = (picture, &frame.picture) {
            sensor.check(file, None)?;
        }
    }
    Ok(())
}

/// The frames with their times, in the order of their numbers.
fn frames(
    images: Images,
    times: &FrameTimes,
    calibrations: usize,
) -> Result<Vec<FrameFiles>, FramesError> {
    let Images { frames, list, .. } = images;
    let frame = |(index, (number, images)): (usize, (u128, FrameImages))| {
        let calibration = index.min(calibrations - 1);
        match times.get(&number) {
            Some(&time) => Ok(FrameFiles { time, calibration, images }),
            None => {
                let path = images.depth.or(images.picture).unwrap_or_default();
                Err(FramesError::NoTime { path, times: list.clone(), number })
            }
        }
    };
    frames.into_iter().enumerate().map(frame).collect()
}

/// The intrinsics that a `cameras.toml` states for this folder, scaled to the size of `image`.
/// `None` if it states none.
fn mounted_intrinsics(
    wanted: &Wanted<'_>,
    image: &Path,
) -> Result<Option<IntrinsicsFile>, FramesError> {
    let Some(camera) = mounted(wanted.folder)? else { return Ok(None) };
    let ((width, height), _) = raster::look(image)
        .map_err(|error| FramesError::Damaged { path: image.to_owned(), error })?;
    let scale = wanted.reading.depth_per_metre;
    let of = |pinhole| {
        let file = IntrinsicsFile::of(&pinhole, None);
        IntrinsicsFile { depth_per_metre: scale.unwrap_or(file.depth_per_metre), ..file }
    };
    Ok(camera.intrinsics(width, height).map(of))
}

/// The poses of a trajectory at the times of the frames, if both have times and are not simply numbered
/// alike: one for each frame, or one if the camera stands still. Images without a pose are removed, with
/// a note.
fn timed_poses(
    folder: &Path,
    images: &mut Images,
    stated: Option<&FrameTimes>,
    notes: &mut Vec<String>,
) -> Result<Option<Vec<CameraPose>>, FramesError> {
    let Some(times) = stated.or(images.times.as_ref()).filter(|_| has_poses(folder)) else {
        return Ok(None);
    };
    let times: Option<Vec<f64>> =
        images.frames.keys().map(|number| Some(times.get(number)?.captured_s)).collect();
    let (path, poses) = read_poses(folder)?;
    let is_numbered = stated.is_some() && poses.len() == images.frames.len();
    let has_stamps = poses.iter().all(|pose| pose.stamp_s.is_some());
    let Some(times) = times.filter(|_| poses.len() > 1 && has_stamps && !is_numbered) else {
        return Ok(None);
    };
    let found = at_times(&path, &poses, &times)?;
    let frames = found.len();
    let mut has_pose = found.iter().map(Option::is_some);
    images.frames.retain(|_, _| has_pose.next().unwrap_or(false));
    if let Some(times) = &mut images.times {
        times.retain(|number, _| images.frames.contains_key(number));
    }
    let mut poses: Vec<CameraPose> = found.into_iter().flatten().collect();
    if poses.len() < frames {
        notes.push(format!(
            "{} of {frames} frames have no pose and are left out",
            frames - poses.len()
        ));
    }
    if is_still(&poses) {
        poses.truncate(1);
    }
    Ok(Some(poses))
}

/// The frames whose poses are wanted.
struct Wanted<'a> {
    folder: &'a Path,
    reading: Reading,
    frames: usize,
    /// The poses in the folder, if they were found by time.
    timed: Option<Vec<CameraPose>>,
}

impl Wanted<'_> {
    /// The poses in a folder, the camera's or that of its pictures: one, or one for each frame.
    fn poses(&self, folder: &Path) -> Result<Vec<CameraPose>, FramesError> {
        if let Some(timed) = self.timed.as_ref().filter(|_| folder == self.folder) {
            return Ok(timed.clone());
        }
        if !has_poses(folder) {
            if let Some(pose) = mounted(folder)?.and_then(|camera| camera.pose()) {
                let rotation = *pose.rotation.to_rotation_matrix().matrix();
                return Ok(vec![CameraPose::computed(pose.translation.vector, rotation)]);
            }
            // Without the depth sensor's pose, that of the pictures says nothing.
            if self.reading.may_lack_poses && !has_poses(&pictures_in(folder)) {
                return Ok(vec![CameraPose::computed(NOWHERE.into(), Matrix3::identity())]);
            }
        }
        let (path, poses) = read_poses(folder)?;
        if poses.len() != 1 && poses.len() != self.frames {
            return Err(FramesError::Poses { path, frames: self.frames, poses: poses.len() });
        }
        Ok(poses)
    }
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
