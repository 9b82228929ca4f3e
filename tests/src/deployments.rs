//! Deployments for tests.

use ubimap_protocol::units::Millimetres;
use ubimap_sim_host::deployment::{Config, Deployment, Life};

/// A deployment with the given cell size, without cameras, robots, coordination or store.
///
/// # Panics
/// Never: there are no markers to confuse.
pub fn bare(resolution: Millimetres) -> Deployment {
    deployed(Config::new(resolution))
}

/// The first life of a deployment without a store.
///
/// # Panics
/// If the robots' markers can't be told apart.
pub fn deployed(config: Config) -> Deployment {
    Deployment::new(config, Life::default()).expect("the markers can be told apart")
}
