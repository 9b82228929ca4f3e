//! Recorded frames of one or more fixed RGB-D cameras: their layout on disk, a player and a writer.
//!
//! ```text
//! robots.toml           the robots and their markers: see `deployment::registry`
//! cameras.toml          poses and fields of view of cameras whose folders state none: see
//!                       `camera::CamerasFile`
//! CAMERA/               one folder per camera; cameras are numbered in the order of their names.
//!                       With a single camera, the files below may lie beside robots.toml
//!   pose.txt            pose of the depth sensor: x y z qx qy qz qw
//!   intrinsics.toml     its width, height, fx, fy, cx, cy, distortion, depth_per_metre and depth_noise
//!   depth/*.png, *.pgm  16-bit grey
//!   color/*.png ...     pictures, grey or colour; also .jpg, .bmp, .ppm and .pgm
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
//! with a time stamp.
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
//! - Without an `intrinsics.toml`, any `*.json` in the folder is read as Open3D's camera file: keep
//!   other JSON files elsewhere.
//! - A camera learns its background from 15 depth images at least 0.3 s apart, and reports no cells
//!   before.
//! - A frame that arrives more than 5 s after its capture is ignored.

mod camera_folder;
mod error;
mod frame_times;
mod playback;
mod recorder;
#[cfg(test)]
mod tests;

pub use error::FramesError;
pub use playback::RecordedFrames;
pub use recorder::Recorder;
