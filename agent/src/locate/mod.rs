//! Localisation: where the robot is, and where it was when a scan was taken.

mod covariance;
mod estimate;
mod filter;
mod history;
mod locator;
mod odometry;
mod systematic;
#[cfg(test)]
mod tests;

pub use estimate::Variances;
pub use filter::{Backwards, FixError, FixOutcome};
pub use locator::{Located, Locator, PoseSource, UncertaintyLimit};
pub use odometry::OdometryNoise;
