//! From the map to the wheels.
//!
//! A [`PlanningWindow`] of the map about the robot says where it may be; a [`Planner`] finds the way there
//! to a goal or to the frontier that is worth most; a [`Follower`] drives it as fast as what its
//! own sensor sees allows; [`Safety`] lets it stand when something is amiss; a [`Driver`] ties them
//! together. [`Stops`] are Ahmed's way, who
//! maps only where a robot stands. A [`BoundaryFollower`] needs no map.

mod boundary;
mod driver;
mod follow;
mod look;
mod near;
mod path;
mod plan;
mod plane;
mod planning_window;
mod reason;
mod root;
mod safety;
mod search;
mod stops;

#[cfg(test)]
mod oracle;
#[cfg(test)]
mod simulation;

pub use boundary::BoundaryFollower;
pub use driver::{Config, Driver, Inputs, Task};
pub use follow::{DriveCommand, Follower, Hindrance, Motion, Sight};
pub use look::Gaze;
pub use near::{MAX_POINTS, NearPoints};
pub use path::Path;
pub use plan::{PlanError, Planner, Progress, Target};
pub use plane::{Place, Plane, SIDE};
pub use planning_window::{GivenUp, GroundRow, MAX_LEVEL, Mover, PlanningWindow, WindowInputs};
pub use reason::Reason;
pub use safety::{Health, Safety, SafetyLimits};
pub use stops::Stops;
