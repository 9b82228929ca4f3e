//! The images of a recorded camera, paired to frames.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use super::{
    error::FramesError,
    frame_times::{FrameTime, FrameTimes, TIMES_FILE},
};
use crate::recording::{
    error::LogError,
    image_times::{image_times, list_of},
    numbered_files::{PICTURE_KINDS, depth_images, files_in, number_in},
};

/// The folder of a camera's pictures, as it is written.
pub(super) const PICTURES: &str = "color";
/// The folder of the pictures in recordings of others, if there is no [`PICTURES`].
const OTHER_PICTURES: &str = "rgb";

/// Maximum time in seconds between a depth image and a picture of one frame, if both have times of
/// their own; as in the TUM benchmark.
const PAIRED_S: f64 = 0.02;

/// The image files of one frame.
#[derive(Clone, Debug, Default)]
pub(super) struct FrameImages {
    pub(super) depth: Option<PathBuf>,
    pub(super) picture: Option<PathBuf>,
}

/// The images of a camera.
#[derive(Debug)]
pub(super) struct Images {
    /// The images of each frame, by its number.
    pub(super) frames: BTreeMap<u128, FrameImages>,
    /// The capture times of the frames, if the images state them.
    pub(super) times: Option<FrameTimes>,
    /// The file from which the times are, if there is one: for errors.
    pub(super) list: PathBuf,
}

/// The folder of the pictures in a camera's folder.
pub(super) fn pictures_in(folder: &Path) -> PathBuf {
    let other = folder.join(OTHER_PICTURES);
    if other.is_dir() && !folder.join(PICTURES).is_dir() { other } else { folder.join(PICTURES) }
}

impl Images {
    /// The images in a camera's folder. With a file of times, there may be none: then all frames were
    /// lost; and times of the images themselves do not count.
    pub(super) fn find(folder: &Path) -> Result<Self, FramesError> {
        let times_file = folder.join(TIMES_FILE);
        let has_times = times_file.is_file();
        let (depths, pictures) = image_files(folder, has_times)?;
        let timed = |images: &[PathBuf]| if has_times { Ok(None) } else { image_times(images) };
        let (depth_times, picture_times) = (timed(&depths)?, timed(&pictures)?);
        let list = if depth_times.is_some() {
            list_of(&folder.join("depth"))
        } else if picture_times.is_some() {
            list_of(&pictures_in(folder))
        } else {
            times_file
        };
        let are_timed = (depths.is_empty() || depth_times.is_some())
            && (pictures.is_empty() || picture_times.is_some());
        // Numbers in the names order images without times, and pair them.
        let mut images = Self { frames: BTreeMap::new(), times: None, list };
        let depth_times = depth_times.unwrap_or_default();
        let picture_times = picture_times.unwrap_or_default();
        for (index, path) in depths.into_iter().enumerate() {
            let time = depth_times.get(index).copied();
            let number = time.filter(|_| are_timed).map_or_else(|| number_in(&path), micros);
            let frame = images.frame(number, time);
            let other = frame.depth.replace(path.clone());
            unique(path, other, number)?;
        }
        let depth_numbers: Vec<u128> = images.frames.keys().copied().collect();
        for (index, path) in pictures.into_iter().enumerate() {
            let time = picture_times.get(index).copied();
            let number = time.filter(|_| are_timed).map_or_else(
                || number_in(&path),
                |time| nearest(&depth_numbers, &images, time).unwrap_or(micros(time)),
            );
            let frame = images.frame(number, time);
            let other = frame.picture.replace(path.clone());
            unique(path, other, number)?;
        }
        Ok(images)
    }

    /// The images of a frame, which is added if it is new.
    fn frame(&mut self, number: u128, time_s: Option<f64>) -> &mut FrameImages {
        if let Some(time_s) = time_s {
            let time = FrameTime { captured_s: time_s, arrived_s: time_s };
            self.times.get_or_insert_default().entry(number).or_insert(time);
        }
        self.frames.entry(number).or_default()
    }

    /// The first depth image, and the first picture.
    pub(super) fn first(&self) -> [Option<&PathBuf>; 2] {
        let depth = self.frames.values().find_map(|it| it.depth.as_ref());
        [depth, self.frames.values().find_map(|it| it.picture.as_ref())]
    }
}

/// The number of a frame that was captured at a time in seconds: microseconds.
fn micros(time_s: f64) -> u128 {
    (time_s * 1e6).round() as u128
}

/// The nearest depth image to a time that has no picture yet.
fn nearest(depths: &[u128], images: &Images, time_s: f64) -> Option<u128> {
    let wanted = micros(time_s);
    let after = depths.partition_point(|&number| number < wanted);
    let beside = depths[after.saturating_sub(1)..].iter().take(2);
    let free = beside.filter(|number| images.frames[*number].picture.is_none());
    let number = *free.min_by_key(|number| number.abs_diff(wanted))?;
    (number.abs_diff(wanted) <= micros(PAIRED_S)).then_some(number)
}

fn unique(path: PathBuf, other: Option<PathBuf>, number: u128) -> Result<(), FramesError> {
    match other {
        Some(other) => Err(FramesError::SameNumber { path, other, number }),
        None => Ok(()),
    }
}

/// The depth images and the pictures in a camera's folder.
fn image_files(
    folder: &Path,
    has_times: bool,
) -> Result<(Vec<PathBuf>, Vec<PathBuf>), FramesError> {
    let or_lost = |images| match images {
        Err(LogError::Empty { .. }) if has_times => Ok(Vec::new()),
        images => images,
    };
    let pictures = pictures_in(folder);
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
