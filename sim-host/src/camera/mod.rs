//! What a camera is, what it takes and what is seen in it.
//!
//! Frames come from a [`FrameSource`]: simulated cameras and recorded folders implement it, and
//! nothing downstream knows which it is. Perception makes an [`Observation`] of each. Ideal cameras
//! see without frames: they are a [`Source`] of observations.

mod calibration;
mod cameras_file;
mod depth_noise;
mod error;
mod frame;
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
pub use thing::{LAYERS, Thing};

/// What one frame of one camera says, after perception.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Observation {
    /// Which camera, numbered from zero.
    pub camera: usize,
    /// When the frame was captured, in the server's clock.
    pub captured: Instant,
    /// The robots that it localised.
    pub robots: Vec<Sighting>,
    /// The cells that it sees, by grid coordinates (cells from the origin of `map`): free or
    /// occupied. A cell in its field of view that is hidden from it is not listed.
    pub cells: Vec<((i32, i32), Cell)>,
    /// What stands out of the empty room; its cells are among [`Observation::cells`], movable.
    pub things: Vec<Thing>,
}

/// Where a robot was when a frame was captured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sighting {
    /// Which robot.
    pub robot: RobotId,
    /// `base_link` in `map`.
    pub pose: Pose,
    /// How sure it is.
    pub certainty: Certainty,
}

impl Sighting {
    /// One that is good for two centimetres and a degree.
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
