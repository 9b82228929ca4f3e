//! The configuration of a robot that plans, follows paths and stops by the map.

use ubimap_protocol::{message::Waypoint, time::Duration};

use super::{follow::Motion, look::Gaze, safety::SafetyLimits};

/// The configuration of a robot that drives along the server's paths.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Driving {
    /// The robot's size and dynamics.
    pub motion: Motion,
    /// When it must stop.
    pub safety: SafetyLimits,
    /// Time between steps, at most 100 ms: braking distances assume that.
    pub interval: Duration,
    /// Whether the robot stops to map, and maps only where it was localised while standing (Ahmed
    /// 3). It stops whenever the mapping gate opens.
    pub stop_and_wait: bool,
    /// Explore autonomously until the first session, then return to this point of `map`. Requires
    /// poses from odometry ([`PoseSource::Odometry`](crate::locate::PoseSource)).
    pub alone: Option<Waypoint>,
    /// Whether to explore ground covered by cameras, too.
    pub explore_covered: bool,
    /// What to look for at a goal before reporting arrival; `None`: nothing.
    pub looks_at_goal: Option<Gaze>,
    /// Maximum number of corners that a search expands in a step, about 5,000 instructions each.
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
