//! Deployments for tests.

use ubimap_protocol::units::Millimetres;
use ubimap_sim_host::deployment::{Config, Deployment, Life};

/// A deployment with cells of this side and nothing else: no cameras, no registered robots, no
/// coordination, and nothing kept.
///
/// # Panics
/// Never: there are no markers to be told apart.
pub fn bare(resolution: Millimetres) -> Deployment {
    deployed(Config::new(resolution))
}

/// The first life of a deployment that keeps nothing.
///
/// # Panics
/// If the robots' markers can't be told apart.
pub fn deployed(config: Config) -> Deployment {
    Deployment::new(config, Life::default()).expect("markers that can be told apart")
}
