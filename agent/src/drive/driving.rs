//! How a robot drives that plans, follows and stops by the map: its configuration.

use ubimap_protocol::{message::Waypoint, time::Duration};

use super::{follow::Motion, look::Gaze, safety::SafetyLimits};

/// The configuration of a robot that drives along the paths that the server sends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Driving {
    /// What the robot can do.
    pub motion: Motion,
    /// When it must stand.
    pub safety: SafetyLimits,
    /// From one step to the next. 100 ms or less: braking distances are computed for that.
    pub interval: Duration,
    /// Whether the robot stops to map, and maps only where it has been localised while it stood
    /// (Ahmed 3). It stops where the gate of its mapping opens.
    pub stop_and_wait: bool,
    /// Whether the robot explores by itself until the first session, and then comes home to this
    /// point of `map`. Its poses must come from odometry
    /// ([`PoseSource::Odometry`](crate::locate::PoseSource)).
    pub alone: Option<Waypoint>,
    /// Whether ground that the cameras see is worth exploring, too.
    pub explore_covered: bool,
    /// What it looks around for at a goal, before it has arrived.
    pub looks_at_goal: Option<Gaze>,
    /// Corners that a search may expand in a step, about 5,000 instructions each.
    pub corners_per_step: usize,
}

impl Default for Driving {
    /// Steps at 20 Hz, eight corners each, on the move.
    fn default() -> Self {
        Self {
            motion: Motion::default(),
            safety: SafetyLimits::default(),
            interval: Duration::from_millis(50),
            stop_and_wait: false,
            alone: None,
            explore_covered: false,
            looks_at_goal: None,
            corners_per_step: 8,
        }
    }
}
