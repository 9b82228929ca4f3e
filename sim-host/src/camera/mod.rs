//! Cameras: calibration, frames, and the observations made from frames.
//!
//! Frames come from a [`FrameSource`]: simulated cameras and recorded folders implement it, and
//! everything downstream treats them alike. Perception turns each frame into an [`Observation`]. Ideal
//! cameras have no frames: they are a [`Source`] of observations.

mod calibration;
mod cameras_file;
mod depth_noise;
mod error;
mod frame;
mod orientation;
mod pixels;
mod sender_clock;
pub mod stream;
mod thing;

use ubimap_protocol::{
    message::Certainty,
    tile::Cell,
    time::Instant,
    units::{Pose, RobotId},
};

pub use calibration::{Calibration, Intrinsics, Lens};
pub use cameras_file::{CAMERAS_FILE, CamerasFile, MountedCamera};
pub use depth_noise::DepthNoise;
pub use error::CalibrationError;
pub use frame::{DepthImage, Frame, FrameSource, Picture};
pub use orientation::Orientation;
pub use pixels::PixelFormat;
pub use sender_clock::SenderClock;
pub use thing::{LAYERS, Thing};

/// The result of perception for one frame of one camera.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Observation {
    /// The camera's index, from zero.
    pub camera: usize,
    /// When the frame was captured, in the server's clock.
    pub captured: Instant,
    /// The robots localised in the frame.
    pub robots: Vec<Sighting>,
    /// The observed cells by grid coordinates (cells from the origin of `map`): free, occupied,
    /// movable, or unknown if an earlier observation is revoked. Occluded cells are not listed.
    pub cells: Vec<((i32, i32), Cell)>,
    /// Objects that are not part of the empty room. Their cells are also in [`Observation::cells`], as
    /// movable.
    pub things: Vec<Thing>,
}

/// The pose of a robot when a frame was captured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sighting {
    /// The robot's number.
    pub robot: RobotId,
    /// `base_link` in `map`.
    pub pose: Pose,
    /// The standard deviations of the pose.
    pub certainty: Certainty,
}

impl Sighting {
    /// A sighting with standard deviations of two centimetres and one degree.
    pub fn usual(robot: RobotId, pose: Pose) -> Self {
        Self { robot, pose, certainty: Certainty { x: 20, y: 20, heading: 182 } }
    }
}

/// A source of observations.
pub trait Source {
    /// The next observation whose frame has arrived by `now` (server's clock), oldest first.
    fn poll(&mut self, now: Instant) -> Option<Observation>;

    /// When the next frame will arrive, or `None` if there will be no more.
    fn next_arrival(&self) -> Option<Instant>;
}
