//! Plays recorded frames in the order in which they arrived.

use std::{
    collections::VecDeque,
    num::NonZero,
    panic::resume_unwind,
    path::{Path, PathBuf},
    sync::Arc,
    thread,
};

use image::{DynamicImage, imageops::flip_vertical_in_place};
use nalgebra::Isometry3;
use ubimap_protocol::time::Instant;

use super::{
    camera_folder::{self, CameraFolder, Reading, SensorFiles},
    error::FramesError,
    frame_times::{MAX_SPAN_S, TIMES_FILE},
    images::FrameImages,
};
use crate::{
    camera::{Calibration, CalibrationError, DepthImage, Frame, FrameSource, Picture},
    grid::raster,
    recording::{
        depth_image::depths_mm,
        error::{FrameFault, LogError},
    },
};

/// Maximum number of cameras: each takes megabytes of memory.
const MAX_CAMERAS: usize = 64;

/// The recorded frames of one or more cameras, as a source of frames.
#[derive(Debug)]
pub struct RecordedFrames {
    names: Vec<String>,
    calibrations: Vec<Calibration>,
    is_placed: Vec<bool>,
    frames: Vec<u64>,
    lost: Vec<u64>,
    /// The recording's clock, in whole seconds, when the time of this source is zero.
    origin_s: f64,
    /// Frames not read yet, in order of arrival.
    rest: VecDeque<Due>,
    /// Frames read ahead.
    read: VecDeque<(Instant, Result<Frame, FramesError>)>,
    fault: Option<FramesError>,
    notes: Vec<String>,
}

/// A frame that has not been read yet.
#[derive(Debug)]
struct Due {
    arrived: Instant,
    captured: Instant,
    camera: usize,
    folder: Arc<CameraFolder>,
    /// Index among the frames of its folder.
    index: usize,
}

impl RecordedFrames {
    /// Opens camera folders, or folders that contain them. Checks everything except the pixels.
    ///
    /// # Errors
    /// Every [`FramesError`].
    pub fn open(paths: &[PathBuf]) -> Result<Self, FramesError> {
        Self::open_with(paths, Reading::default())
    }

    /// Opens camera folders like [`open`](Self::open), read as `reading` says.
    ///
    /// # Errors
    /// Every [`FramesError`].
    pub fn open_with(paths: &[PathBuf], reading: Reading) -> Result<Self, FramesError> {
        let mut folders = Vec::new();
        for path in paths {
            for path in camera_folder::find(path)? {
                folders.push(Arc::new(CameraFolder::open(&path, reading)?));
            }
        }
        one_clock(&folders)?;
        let captured = folders.iter().flat_map(|it| &it.frames).map(|frame| frame.time.captured_s);
        // Whole seconds, so that the fractions of a second are the same in both clocks.
        let origin_s = captured.reduce(f64::min).unwrap_or(0.0).floor();
        let moment = |seconds: f64| Instant(((seconds - origin_s) * 1e6).round() as u64);

        let mut all = Self {
            names: Vec::new(),
            calibrations: Vec::new(),
            is_placed: Vec::new(),
            frames: Vec::new(),
            lost: Vec::new(),
            origin_s,
            rest: VecDeque::new(),
            read: VecDeque::new(),
            fault: None,
            notes: Vec::new(),
        };
        let mut rest = Vec::new();
        for folder in folders {
            let first = all.calibrations.len();
            all.calibrations.extend(&folder.calibrations);
            let cameras = all.calibrations.len();
            if cameras > MAX_CAMERAS {
                let path = folder.path.clone();
                return Err(FramesError::TooMany { path, cameras, most: MAX_CAMERAS });
            }
            all.names.extend((0..cameras - first).map(|index| folder.name(index)));
            all.is_placed.resize(cameras, folder.is_placed);
            all.frames.resize(cameras, 0);
            all.lost.resize(cameras, 0);
            all.lost[first] = folder.lost;
            let named = |note| format!("{}: {note}", folder.path.display());
            all.notes.extend(folder.notes.iter().map(named));
            for (index, frame) in folder.frames.iter().enumerate() {
                let camera = first + frame.calibration;
                let (arrived, captured) =
                    (moment(frame.time.arrived_s), moment(frame.time.captured_s));
                rest.push(Due { arrived, captured, camera, folder: folder.clone(), index });
            }
        }
        rest.sort_by_key(|due| (due.arrived, due.captured, due.camera));
        all.rest = rest.into();
        Ok(all)
    }

    /// The names of the cameras.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// The stated poses of the cameras in `map`, in metres: those of their depth sensors.
    pub fn stated_poses(&self) -> impl Iterator<Item = Option<&Isometry3<f64>>> {
        let cameras = self.calibrations.iter().zip(&self.is_placed);
        cameras.map(|(camera, is_placed)| camera.pose().filter(|_| *is_placed))
    }

    /// Moves the cameras to these poses in `map`, in metres.
    ///
    /// # Errors
    /// [`CalibrationError::Pose`] if a pose is not finite.
    pub fn place(&mut self, poses: &[Isometry3<f64>]) -> Result<(), CalibrationError> {
        for (camera, pose) in self.calibrations.iter_mut().zip(poses) {
            *camera = camera.at(*pose)?;
        }
        Ok(())
    }

    /// For each camera, the number of frames played so far, and the total number of lost frames.
    pub fn counts(&self) -> impl Iterator<Item = (u64, u64)> {
        self.frames.iter().copied().zip(self.lost.iter().copied())
    }

    /// Converts a time of this source to the recording's clock, in seconds.
    pub fn clock_s(&self, moment: Instant) -> f64 {
        self.origin_s + moment.micros() as f64 / 1e6
    }

    /// Arrival time of the last frame.
    pub fn end(&self) -> Instant {
        self.rest.back().map_or(Instant(0), |due| due.arrived)
    }

    /// Notes for the user, one line each.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// The error that ended playback early, if any: an image that cannot be read.
    pub fn take_fault(&mut self) -> Option<FramesError> {
        self.fault.take()
    }

    /// Reads the next frames in parallel, one on each processor.
    fn read_ahead(&mut self) {
        let abreast = thread::available_parallelism().map_or(1, NonZero::get);
        let next: Vec<Due> = self.rest.drain(..abreast.min(self.rest.len())).collect();
        let frames: Vec<_> = thread::scope(|scope| {
            let at_work: Vec<_> = next.iter().map(|due| scope.spawn(|| due.read())).collect();
            let frames = at_work.into_iter().map(|thread| thread.join());
            frames.map(|frame| frame.unwrap_or_else(|panic| resume_unwind(panic))).collect()
        });
        self.read.extend(next.iter().map(|due| due.arrived).zip(frames));
    }
}

impl FrameSource for RecordedFrames {
    fn cameras(&self) -> &[Calibration] {
        &self.calibrations
    }

    fn poll(&mut self, now: Instant) -> Option<Frame> {
        if self.next_arrival()? > now {
            return None;
        }
        if self.read.is_empty() {
            self.read_ahead();
        }
        match self.read.pop_front()?.1 {
            Ok(frame) => {
                self.frames[frame.camera] += 1;
                Some(frame)
            }
            Err(error) => {
                self.fault = Some(error);
                self.rest.clear();
                self.read.clear();
                None
            }
        }
    }

    fn next_arrival(&self) -> Option<Instant> {
        let read = self.read.front().map(|(arrived, _)| *arrived);
        read.or_else(|| self.rest.front().map(|due| due.arrived))
    }
}

impl Due {
    fn read(&self) -> Result<Frame, FramesError> {
        let CameraFolder { depth, picture, frames, .. } = &*self.folder;
        let FrameImages { depth: depth_file, picture: picture_file } = &frames[self.index].images;
        let depth = depth_file.as_deref().zip(depth.as_ref());
        let depth = depth.map(|(path, sensor)| depth_image(path, sensor)).transpose()?;
        let picture = picture_file.as_deref().zip(picture.as_ref());
        let picture = picture.map(|(path, sensor)| read_picture(path, sensor)).transpose()?;
        Ok(Frame { camera: self.camera, captured: self.captured, depth, picture })
    }
}

/// Checks that either all cameras have a file of times, by one clock, or none has.
fn one_clock(folders: &[Arc<CameraFolder>]) -> Result<(), FramesError> {
    let times_of = |folder: &CameraFolder| folder.path.join(TIMES_FILE);
    let [with, without] = [true, false].map(|has| folders.iter().find(|it| it.has_clock == has));
    if let Some((with, without)) = with.zip(without) {
        return Err(FramesError::NoClock { path: times_of(without), other: times_of(with) });
    }
    let begin = |folder: &CameraFolder| folder.frames.first().map(|it| it.time.captured_s);
    let mut begun: Vec<_> = folders.iter().filter_map(|it| Some((begin(it)?, it))).collect();
    begun.sort_by(|a, b| a.0.total_cmp(&b.0));
    if let [(first_s, first), .., (last_s, last)] = &begun[..]
        && last_s - first_s > MAX_SPAN_S
    {
        return Err(FramesError::OtherClock { path: times_of(last), other: times_of(first) });
    }
    Ok(())
}

/// Reads a depth image. If the sensor's y axis points up (negative focal length), the rows are
/// reversed.
fn depth_image(path: &Path, sensor: &SensorFiles) -> Result<DepthImage, FramesError> {
    let depths = depths_mm(path, &sensor.intrinsics).map_err(|error| match error {
        LogError::Frame { path, fault: FrameFault::Image(error) } => {
            FramesError::Damaged { path, error }
        }
        error => error.into(),
    })?;
    let (width, height) = (sensor.intrinsics.width, sensor.intrinsics.height);
    // The depths have the size in the intrinsics, so this cannot fail.
    let mut image = DepthImage::from_raw(width, height, depths).unwrap_or_default();
    if sensor.is_upside_down() {
        flip_vertical_in_place(&mut image);
    }
    Ok(image)
}

fn read_picture(path: &Path, sensor: &SensorFiles) -> Result<Picture, FramesError> {
    let mut image = raster::read(path)
        .map_err(|error| FramesError::Damaged { path: path.to_owned(), error })?
        .image;
    if sensor.is_upside_down() {
        flip_vertical_in_place(&mut image);
    }
    Ok(match image {
        DynamicImage::ImageLuma8(grey) => Picture::Grey(grey),
        DynamicImage::ImageLuma16(_)
        | DynamicImage::ImageLumaA8(_)
        | DynamicImage::ImageLumaA16(_) => Picture::Grey(image.into_luma8()),
        _ => Picture::Colour(image.into_rgb8()),
    })
}
