//! Writes frames to a folder, in the layout that [`frames`](super) describes.

use std::{
    fs::{self, File},
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
};

use image::{
    ImageError,
    codecs::png::{CompressionType, FilterType, PngEncoder},
};
use ubimap_protocol::time::Instant;

use super::{frame_times::TIMES_FILE, images::PICTURES};
use crate::{
    camera::{Calibration, DepthNoise, Frame, Lens, Picture},
    recording::{
        error::LogError,
        intrinsics::{INTRINSICS_FILE, IntrinsicsFile},
    },
};

/// Writes frames to a folder as they arrive. A frame's number is its capture time in microseconds.
#[derive(Debug)]
pub struct Recorder {
    cameras: Vec<CameraWriter>,
}

#[derive(Debug)]
struct CameraWriter {
    folder: PathBuf,
    times: File,
}

impl Recorder {
    /// Creates a folder for the frames of these cameras and writes their calibrations. Their folders are named
    /// by their numbers.
    ///
    /// # Errors
    /// [`LogError::Io`] if the folder cannot be written to, or is not empty.
    pub fn create(folder: &Path, cameras: &[Calibration]) -> Result<Self, LogError> {
        let named = cameras.iter().enumerate();
        let named = named.map(|(index, camera)| (format!("camera-{index:02}"), *camera));
        Self::create_named(folder, &named.collect::<Vec<_>>())
    }

    /// As [`Recorder::create`], with the names of the cameras' folders.
    ///
    /// # Errors
    /// [`LogError::Io`]; also if a name is not that of a folder.
    pub fn create_named(
        folder: &Path,
        cameras: &[(String, Calibration)],
    ) -> Result<Self, LogError> {
        let refuse = |error| LogError::Io { path: folder.to_owned(), error };
        fs::create_dir_all(folder).map_err(refuse)?;
        if fs::read_dir(folder).map_err(refuse)?.next().is_some() {
            let reason = "the folder is not empty; record to another one";
            return Err(refuse(io::Error::other(reason)));
        }
        let cameras = cameras.iter().map(|(name, camera)| {
            if Path::new(name).file_name() != Some(name.as_ref()) {
                let reason = format!("no folder can be named as the camera {name:?}; rename it");
                return Err(refuse(io::Error::other(reason)));
            }
            CameraWriter::create(folder.join(name), camera)
        });
        Ok(Self { cameras: cameras.collect::<Result<_, _>>()? })
    }

    /// Writes a frame that arrived at `now`.
    ///
    /// # Errors
    /// [`LogError::Io`].
    pub fn write(&mut self, frame: &Frame, now: Instant) -> Result<(), LogError> {
        self.cameras.get_mut(frame.camera).map_or(Ok(()), |camera| camera.write(frame, now))
    }
}

impl CameraWriter {
    fn create(folder: PathBuf, camera: &Calibration) -> Result<Self, LogError> {
        create_folder(&folder)?;
        if let Some(lens) = &camera.depth {
            calibrate(&folder, lens, Some(&camera.depth_noise))?;
        }
        if let Some(lens) = &camera.picture {
            calibrate(&folder.join(PICTURES), lens, None)?;
        }
        let path = folder.join(TIMES_FILE);
        let times = write_file(&path, |file| writeln!(file, "# frame, captured (s), arrived (s)"))?;
        Ok(Self { folder, times })
    }

    fn write(&mut self, frame: &Frame, now: Instant) -> Result<(), LogError> {
        let number = frame.captured.micros();
        let seconds = |moment: Instant| {
            let micros = moment.micros();
            format!("{}.{:06}", micros / 1_000_000, micros % 1_000_000)
        };
        let [captured, arrived] = [frame.captured, now].map(seconds);
        // The line is written and flushed first. If the recording is interrupted, a line without
        // images is read as a lost frame, whereas an image without a line would make the folder
        // unreadable.
        let line = format!("{number:012} {captured} {arrived}\n");
        self.times
            .write_all(line.as_bytes())
            .map_err(|error| LogError::Io { path: self.folder.join(TIMES_FILE), error })?;
        let path = |images: &str| self.folder.join(images).join(format!("{number:012}.png"));
        if let Some(depth) = &frame.depth {
            write_png(&path("depth"), |to| depth.write_with_encoder(to))?;
        }
        match &frame.picture {
            Some(Picture::Grey(grey)) => {
                write_png(&path(PICTURES), |to| grey.write_with_encoder(to))
            }
            Some(Picture::Colour(rgb)) => {
                write_png(&path(PICTURES), |to| rgb.write_with_encoder(to))
            }
            None => Ok(()),
        }
    }
}

fn create_folder(path: &Path) -> Result<(), LogError> {
    fs::create_dir_all(path).map_err(|error| LogError::Io { path: path.to_owned(), error })
}

/// Writes the calibration of a sensor into the folder `place`. `noise` is the noise of its depths,
/// if it is a depth sensor.
fn calibrate(place: &Path, lens: &Lens, noise: Option<&DepthNoise>) -> Result<(), LogError> {
    create_folder(place)?;
    // Serialising plain numbers cannot fail.
    let intrinsics =
        toml::to_string(&IntrinsicsFile::of(lens.intrinsics(), noise)).unwrap_or_default();
    write_file(&place.join(INTRINSICS_FILE), |file| file.write_all(intrinsics.as_bytes()))?;
    let (at, turn) = (lens.pose().translation, lens.pose().rotation);
    write_file(&place.join("pose.txt"), |file| {
        writeln!(file, "# x y z qx qy qz qw")?;
        writeln!(file, "{} {} {} {} {} {} {}", at.x, at.y, at.z, turn.i, turn.j, turn.k, turn.w)
    })?;
    Ok(())
}

/// Writes an image, creating its folder if necessary. It is renamed into place once complete.
fn write_png(
    path: &Path,
    encode: impl FnOnce(PngEncoder<&mut BufWriter<&mut File>>) -> Result<(), ImageError>,
) -> Result<(), LogError> {
    path.parent().map_or(Ok(()), create_folder)?;
    let part = path.with_extension("png.part");
    write_file(&part, |file| {
        let mut buffer = BufWriter::new(file);
        let (fast, filter) = (CompressionType::Fast, FilterType::Adaptive);
        let encoder = PngEncoder::new_with_quality(&mut buffer, fast, filter);
        encode(encoder).map_err(|error| match error {
            ImageError::IoError(error) => error,
            error => io::Error::other(error),
        })?;
        buffer.flush()
    })?;
    fs::rename(&part, path).map_err(|error| LogError::Io { path: path.to_owned(), error })
}

fn write_file(
    path: &Path,
    write: impl FnOnce(&mut File) -> io::Result<()>,
) -> Result<File, LogError> {
    let written = File::create(path).and_then(|mut file| {
        write(&mut file)?;
        Ok(file)
    });
    written.map_err(|error| LogError::Io { path: path.to_owned(), error })
}
