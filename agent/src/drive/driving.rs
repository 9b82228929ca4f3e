//! The configuration of a robot that plans and follows paths on the map.

use ubimap_protocol::{message::Waypoint, time::Duration};

use super::{follow::Motion, look::Gaze, safety::SafetyLimits};

/// The configuration of a robot that drives along the server's paths.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Driving {
    /// The robot's size and dynamics.
    pub motion: Motion,
    /// When the robot must stop.
    pub safety: SafetyLimits,
    /// Time between steps, at most 100 ms: braking distances allow for no longer delay.
    pub interval: Duration,
    /// Whether the robot stops for each scan, and maps only scans taken while it stood and was
    /// localised (Ahmed 3). It stops whenever it has moved far enough to map another scan (the
    /// mapping gate opens).
    pub stop_and_wait: bool,
    /// If given, the robot explores on its own until its first session, and returns to this point
    /// of `map` when nothing is left to explore. Requires poses from odometry
    /// ([`PoseSource::Odometry`](crate::locate::PoseSource)).
    pub alone: Option<Waypoint>,
    /// Whether to explore ground covered by cameras, too.
    pub explore_covered: bool,
    /// If given, a robot that has arrived at a goal turns until it has seen the blind ground around
    /// it, and only then reports the arrival.
    pub looks_at_goal: Option<Gaze>,
    /// Maximum number of pairs of obstacle corners that a search examines in a step, 50 to 250
    /// instructions each.
    pub pairs_per_step: usize,
}

impl Default for Driving {
    /// A step every 50 ms with at most 1,000 pairs of corners, and no stops for scans.
    fn default() -> Self {
        Self {
            motion: Motion::default(),
            safety: SafetyLimits::default(),
            interval: Duration::from_millis(50),
            stop_and_wait: false,
            alone: None,
            explore_covered: false,
            looks_at_goal: None,
            pairs_per_step: 1_000,
        }
    }
}
