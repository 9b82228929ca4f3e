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
    /// Time between steps. At most 100 ms, the delay that braking distances allow for.
    pub interval: Duration,
    /// Whether the robot stops for each scan, and maps only scans taken while it stood and was
    /// localised (Ahmed 3). It stops whenever the mapping gate opens.
    pub stop_and_wait: bool,
    /// For a robot that explores autonomously until its first session: the point of `map` to return
    /// to. Requires poses from odometry ([`PoseSource::Odometry`](crate::locate::PoseSource)).
    pub alone: Option<Waypoint>,
    /// Whether to explore ground covered by cameras, too.
    pub explore_covered: bool,
    /// The ground to look at on arrival at a goal, before the arrival is reported. `None`: no look.
    pub looks_at_goal: Option<Gaze>,
    /// Maximum number of obstacle corners that a search expands in a step, about 5,000 instructions
    /// each.
    pub corners_per_step: usize,
}

impl Default for Driving {
    /// A step every 50 ms, eight corners each, and no stops for scans.
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
