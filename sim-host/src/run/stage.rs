//! Where the events of a run come from.

use ubimap_agent::drive::DriveCommand;
use ubimap_protocol::{time::Instant, units::Pose};

use crate::camera::{Frame, Observation};

/// An input to the fleet at a moment of a run.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A robot takes a scan.
    Scan {
        /// The robot's index in the fleet.
        robot: usize,
        /// Readings in millimetres; 0 means no return.
        readings: Vec<u16>,
    },
    /// A robot takes a picture with its grey camera.
    Look {
        /// The robot's index in the fleet.
        robot: usize,
        /// Grey levels, top line first.
        picture: Vec<u8>,
    },
    /// A robot reads its odometry.
    Odometry {
        /// The robot's index in the fleet.
        robot: usize,
        /// Pose of `base_link` in `odom`.
        pose: Pose,
    },
    /// A frame of a camera has arrived.
    Frame(Frame),
    /// An observation of an ideal camera has arrived.
    Observation(Observation),
}

/// A source of events: a log or a simulated room.
pub trait Stage {
    /// Time of the next event; `None` after the last one.
    fn next_event(&self) -> Option<Instant>;

    /// The oldest event that is due by `now`, if any.
    fn poll(&mut self, now: Instant) -> Option<Event>;

    /// Applies a drive command to a robot's wheels from `moment` on.
    fn drive(&mut self, _moment: Instant, _robot: usize, _command: DriveCommand) {}

    /// What a robot's wheels have measured by `now`: the way in metres and the angle in radians since
    /// the start, and whether its bumper is pressed. `None` if the stage has no wheels.
    fn wheels(&mut self, _now: Instant, _robot: usize) -> Option<([f64; 2], bool)> {
        None
    }
}
