//! Folders of depth images as a source of frames, in the form that [`read`](super::read) takes.

use std::{
    collections::VecDeque,
    path::{Path, PathBuf},
};

use nalgebra::{Isometry3, Rotation3, Translation3, UnitQuaternion};
use ubimap_protocol::time::{Duration, Instant};

use super::{
    LogError,
    rgbd::{self, CameraPose},
    slicing::depths_mm,
    times,
};
use crate::camera::{Calibration, DepthImage, Frame, FrameSource, Intrinsics, Lens};

/// Recorded depth images. With one pose for all it is one camera that stands still; with a pose for
/// each, every image counts as a camera of its own.
#[derive(Debug)]
pub struct RecordedFrames {
    cameras: Vec<Calibration>,
    intrinsics: rgbd::Intrinsics,
    /// When each image is due, which camera it is of, and its file; in the order of time.
    rest: VecDeque<(Instant, usize, PathBuf)>,
    notes: Vec<String>,
}

impl RecordedFrames {
    /// Opens a folder. Its poses are those of the cameras in `map`; the first frame is captured at
    /// `start`.
    ///
    /// # Errors
    /// What [`read`](super::read) says of such a folder, and what no camera can be like.
    pub fn open(folder: &Path, start: Instant) -> Result<Self, LogError> {
        let images = rgbd::depth_images(folder)?;
        let (pose_file, poses) = rgbd::read_poses(folder)?;
        if poses.len() != images.len() && poses.len() != 1 {
            let (images, poses) = (images.len(), poses.len());
            return Err(LogError::Poses { path: pose_file, images, poses });
        }
        let (intrinsics, note) = rgbd::find_intrinsics(folder, &images)?;
        let cameras: Result<Vec<_>, _> =
            poses.iter().map(|pose| calibration(&intrinsics, pose)).collect();
        let cameras = cameras.map_err(|error| LogError::Intrinsics {
            path: folder.to_owned(),
            reason: error.to_string(),
        })?;
        let stamps: Option<Vec<f64>> = poses.iter().map(|pose| pose.stamp_s).collect();
        let stamps = stamps.filter(|stamps| stamps.len() == images.len());
        let (times, time_note) = times::repair(stamps.as_deref(), images.len());
        let last = cameras.len() - 1;
        let due = |(index, (time, image)): (usize, (Duration, PathBuf))| {
            (start + time, index.min(last), image)
        };
        let rest = times.into_iter().zip(images).enumerate().map(due).collect();
        Ok(Self { cameras, intrinsics, rest, notes: note.into_iter().chain(time_note).collect() })
    }

    /// What the user should know, one line each.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }
}

impl FrameSource for RecordedFrames {
    fn cameras(&self) -> &[Calibration] {
        &self.cameras
    }

    /// An image that cannot be read is told of in the program's log, and is a frame that is lost.
    fn poll(&mut self, now: Instant) -> Option<Frame> {
        while self.next_arrival()? <= now {
            let (captured, camera, image) = self.rest.pop_front()?;
            match depth_image(&image, &self.intrinsics) {
                Ok(depth) => {
                    return Some(Frame { camera, captured, depth: Some(depth), picture: None });
                }
                Err(error) => ::log::warn!("a frame is lost: {error}"),
            }
        }
        None
    }

    fn next_arrival(&self) -> Option<Instant> {
        self.rest.front().map(|(captured, ..)| *captured)
    }
}

/// Where y points up in an image (a negative focal length), the rows are turned round.
fn depth_image(path: &Path, intrinsics: &rgbd::Intrinsics) -> Result<DepthImage, LogError> {
    let depths = depths_mm(path, intrinsics)?;
    // The depths have the size of the intrinsics.
    let mut image =
        DepthImage::from_raw(intrinsics.width, intrinsics.height, depths).unwrap_or_default();
    if intrinsics.fy < 0.0 {
        image::imageops::flip_vertical_in_place(&mut image);
    }
    Ok(image)
}

fn calibration(
    intrinsics: &rgbd::Intrinsics,
    pose: &CameraPose,
) -> Result<Calibration, crate::camera::CalibrationError> {
    let rgbd::Intrinsics { width, height, fx, fy, cx, mut cy, .. } = *intrinsics;
    if fy < 0.0 {
        cy = f64::from(height) - 1.0 - cy;
    }
    let pinhole = Intrinsics { width, height, fx, fy: fy.abs(), cx, cy, distortion: [0.0; 5] };
    let turn = Rotation3::from_matrix_unchecked(pose.rotation);
    let place = Isometry3::from_parts(
        Translation3::from(pose.position),
        UnitQuaternion::from_rotation_matrix(&turn),
    );
    Ok(Calibration { depth: Some(Lens::new(pinhole, place)?), picture: None })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        perception::{Background, Evidence, Survey, View},
        testing::{Folder, shared_data},
    };

    #[test]
    fn images_come_when_they_are_due_and_a_damaged_one_is_lost() {
        let folder = Folder::new("recorded-frames");
        folder
            .file("intrinsics.toml", b"width = 2\nheight = 1\nfx = 2\nfy = 2\ncx = 0.5\ncy = 0\n");
        folder.file("pose.txt", b"1 2 3 1 0 0 0\n");
        folder.file("depth/1.pgm", b"P2 2 1 65535 1000 0");
        folder.file("depth/2.pgm", b"P2 2 1 65535 1000");
        folder.file("depth/10.pgm", b"P2 2 1 65535 3000 4000");
        let start = Instant(5_000_000);
        let mut source = RecordedFrames::open(folder.path(), start).unwrap();
        let [camera] = source.cameras() else { panic!("one camera") };
        // It looks straight down.
        let floor = camera.depth.unwrap().direction([0.5, 0.0]) * 3.0;
        assert!((floor.z + 3.0).abs() < 1e-9, "{floor}");
        assert_eq!(source.poll(Instant(4_999_999)), None);
        let first = source.poll(start).unwrap();
        assert_eq!((first.camera, first.captured), (0, start));
        assert_eq!(first.depth.unwrap().into_raw(), [1_000, 0]);
        assert_eq!(source.next_arrival(), Some(Instant(6_000_000)));
        let last = source.poll(Instant(9_000_000)).unwrap();
        assert_eq!(last.captured, Instant(7_000_000));
        assert_eq!(last.depth.unwrap().into_raw(), [3_000, 4_000]);
        assert_eq!((source.poll(Instant(9_000_000)), source.next_arrival()), (None, None));
        folder.file("pose.txt", b"1 2 3 1 0 0 0\n1 2 3 1 0 0 0\n");
        let error = RecordedFrames::open(folder.path(), start).unwrap_err().to_string();
        assert!(error.contains("3 depth images but 2 poses"), "{error}");
    }

    /// Real images, with all that is wrong with them, lead to the same evidence both ways.
    #[test]
    fn recorded_images_make_the_same_evidence_both_ways() {
        for name in ["rgbd_redwood", "rgbd_frames/icl_nuim", "rgbd_frames/handheld"] {
            let Some(folder) = shared_data(name) else { continue };
            let mut source = RecordedFrames::open(&folder, Instant(0)).unwrap();
            assert_eq!(source.cameras().len(), 5, "{name}");
            let frames: Vec<Frame> =
                std::iter::from_fn(|| source.poll(Instant(60_000_000))).collect();
            assert_eq!(frames.len(), 5, "{name}");
            let view = View::new(&source.cameras()[0].depth.unwrap(), Survey::default());
            let mut background = Background::new(&view);
            let taken = vec![false; view.cells()];
            let (mut fast, mut plain) = (Evidence::default(), Evidence::default());
            for turn in 0..17 {
                // The first image until it is learnt, then others before the same background.
                let image = frames[(turn as usize).saturating_sub(14)].depth.as_ref().unwrap();
                fast.fuse(&view, &background, image);
                plain.scatter(&view, &background, image);
                assert_eq!(fast, plain, "{name}");
                background.learn(&view, image, Instant(turn * 300_000), &taken);
            }
            assert!(background.is_learnt());
        }
    }
}
