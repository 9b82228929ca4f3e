//! Recorded frames of one or more fixed RGB-D cameras: their layout on disk, a player and a writer.
//!
//! ```text
//! robots.toml           the robots and their markers: see `deployment::registry`
//! cameras.toml          poses and fields of view of cameras whose folders state none: see
//!                       `camera::CamerasFile`
//! CAMERA/               one folder per camera; cameras are numbered in the order of their names.
//!                       With a single camera, the files below may lie beside robots.toml
//!   pose.txt            pose of the depth sensor: x y z qx qy qz qw, or another form (below)
//!   intrinsics.toml     its width, height, fx, fy, cx, cy, distortion, depth_per_metre and depth_noise
//!   *.yaml, *.json      or the camera's file of another program (below)
//!   depth/*.png, *.pgm  16-bit grey
//!   color/*.png ...     pictures, grey or colour; also .jpg, .bmp, .ppm and .pgm; or in rgb/
//!   color/pose.txt      pose of the picture sensor (default: the depth sensor's), and
//!   color/intrinsics.toml  its intrinsics (default: the depth sensor's)
//!   times.txt           one line per frame: NUMBER CAPTURED [ARRIVED]
//! ```
//!
//! Poses, intrinsics and depth images have the form that [`Format::Rgbd`](super::Format::Rgbd)
//! reads. A pose is that of the optical frame (x right, y down, z forward) in `map`, in metres,
//! with z up and the floor at 0. A depth image and a picture with the same number in their names
//! are one frame; either may be missing, in one frame or in all. Times are seconds on one clock
//! shared by all cameras, with any origin; later frames have higher numbers. Frames are played in
//! the order of arrival; without ARRIVED, in the order of capture. A frame that has a time but no
//! image was lost. Without any `times.txt`, frames are one second apart, unless each has a pose
//! with a time stamp, or the images have times of their own.
//!
//! # Recordings of others
//!
//! Poses are in the first of `trajectory.log`, `pose.txt`, `groundtruth.txt`, `trajectory.txt` and
//! `poses.txt`, each in any form; the numbers of a file must all have one:
//!
//! | form | numbers |
//! |---|---|
//! | ours | `x y z qx qy qz qw` on a line |
//! | TUM | a time in seconds before them |
//! | a matrix | 3 or 4 lines of 4 numbers, or 12 or 16 numbers on one line, row by row; brackets and commas are ignored |
//! | Redwood, Open3D | a line of up to three indices before each matrix |
//!
//! A matrix transforms from camera to world; that one was given from world to camera, or in OpenGL's axes,
//! can't be known. What is no rotation is refused. Poses with times are interpolated at the times of the
//! images, which are in `times.txt`, in TUM's lists beside the folders (`depth.txt` and `rgb.txt`: TIME FILE), or
//! in their names (`1305031102.160407.png`). Then a picture belongs to the depth image within 20 ms, frames
//! without a pose are left out, and a camera that stands still in all poses is one camera.
//!
//! Intrinsics are in the one `*.yaml`, `*.yml` or `*.json` that states a camera: OpenCV's `FileStorage`, ROS's
//! `camera_info` (file or message), Open3D's or RealSense's JSON, ORB-SLAM's settings; other YAML and JSON files are
//! ignored. The distortion model must be `plumb_bob` (k1, k2, p1, p2, k3), or have zeros otherwise. Depths are in
//! millimetres unless `depth_scale` or `DepthMapFactor` says otherwise, or `--depth-scale`, which counts first;
//! beside a `depth.txt` one of them is needed.
//!
//! If there is one pose per frame instead of a single one, each frame is treated as a camera of its
//! own. This is for hand-held cameras, which can't learn a background.
//!
//! For example, this is the `pose.txt` of a camera 2.8 m above the origin that looks straight down,
//! with the top of its images towards +y:
//!
//! ```text
//! 0 0 2.8 1 0 0 0
//! ```
//!
//! An `intrinsics.toml`, with focal lengths and centre in pixels. The last three lines are
//! optional: by default there is no distortion, depths are in millimetres, and their noise is that
//! of a D435 (see [`DepthNoise`](crate::camera::DepthNoise)):
//!
//! ```toml
//! width = 640
//! height = 480
//! fx = 525.0
//! fy = 525.0
//! cx = 319.5
//! cy = 239.5
//! distortion = [0.0, 0.0, 0.0, 0.0, 0.0]  # k1, k2, p1, p2, k3
//! depth_per_metre = 1000
//! depth_noise = { constant_m = 0.001, quadratic_per_m = 0.00475 }
//! ```
//!
//! A `times.txt`, in which the third frame arrived before the second:
//!
//! ```text
//! 0001.png 1305031453.25 1305031453.31
//! 0002.png 1305031453.58 1305031453.99
//! 0003.png 1305031453.91 1305031453.97
//! ```
//!
//! - All digits of a name form its number (`cam2_0001.png` has 20001), so use names such as
//!   `0001.png`.
//! - If a camera has only pictures, `pose.txt` and `intrinsics.toml` beside `color/` are those of
//!   the picture sensor.
//! - A camera learns its background from 15 depth images at least 0.3 s apart, and reports no cells
//!   before.
//! - A frame that arrives more than 5 s after its capture is ignored.

mod camera_folder;
mod error;
mod frame_times;
mod images;
mod playback;
mod recorder;
#[cfg(test)]
mod tests;

pub use camera_folder::Reading;
pub use error::FramesError;
pub use playback::RecordedFrames;
pub use recorder::Recorder;
