//! From the map to the wheels.
//!
//! A [`PlanningWindow`] of the map about the robot says where it may be; a [`Planner`] finds the way there
//! to a goal or to the frontier that is worth most; a [`Follower`] drives it as fast as what its
//! own sensor sees allows; [`Safety`] lets it stand when something is amiss; a [`Driver`] ties them
//! together. A [`Navigator`] drives along the server's paths, at its own rate: it is what
//! [`Driving`] configures, one choice of [`Drive`]. [`Stops`] are Ahmed's way, who maps only where
//! a robot stands. A [`BoundaryFollower`] needs no map.

mod boundary;
mod choice;
mod driver;
mod driving;
mod follow;
mod look;
mod navigator;
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
pub use choice::{Drive, Drives, NoDrive, Surroundings};
pub use driver::{Driver, Inputs, Task};
pub use driving::Driving;
pub use follow::{DriveCommand, Follower, Hindrance, Motion, Sight};
pub use look::Gaze;
pub use navigator::Navigator;
pub use near::{MAX_POINTS, NearPoints, Seen};
pub use path::Path;
pub use plan::{PlanError, Planner, Progress, Target};
pub use plane::{Place, Plane, SIDE};
pub use planning_window::{GivenUp, GroundRow, MAX_LEVEL, Mover, PlanningWindow, WindowInputs};
pub use reason::Reason;
pub use safety::{Health, Safety, SafetyLimits};
pub use search::Workspace;
pub use stops::Stops;
