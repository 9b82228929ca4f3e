//! From the map to the wheels.
//!
//! A [`PlanningWindow`] holds the map around the robot and the places where its centre may be. A
//! [`Planner`] finds the shortest path in it, to a goal or to the best frontier: the border of
//! unmapped blind ground, which no camera sees. A [`Follower`] drives the path at a speed that the
//! view of the robot's own sensor allows; [`Safety`] stops the robot on a fault; a [`Driver`] joins
//! these. A [`Navigator`] drives along the server's paths at its own rate; [`Driving`] is its
//! configuration, and one implementation of [`Drive`]. [`Stops`] is Ahmed's method: the robot maps
//! only at standstill. A [`BoundaryFollower`] needs no map; a
//! [`BoundaryWalk`] stops it for each picture.

mod boundary;
mod boundary_walk;
mod choice;
mod driver;
mod driving;
mod follow;
mod halt;
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
pub use boundary_walk::BoundaryWalk;
pub use choice::{Drive, Drives, NoDrive, Surroundings};
pub use driver::{Driver, Inputs, Task};
pub use driving::Driving;
pub use follow::{DriveCommand, Follower, Hindrance, Motion, Sight};
pub(crate) use halt::Halt;
pub use halt::StopReason;
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
