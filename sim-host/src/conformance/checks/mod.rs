//! The checks.

mod frames;
mod parameters;
mod reliable;
mod robot_tiles;
mod robots;
mod seals;
mod server_tiles;
mod servers;

use super::{check::Check, halt::Role};

/// The checks for a role, in the order of their numbers from 1 on.
pub fn checks(role: Role) -> Vec<&'static Check> {
    let (sessions, parameters, tiles): (_, &[Check], _) = match role {
        Role::Robot => (robots::CHECKS, parameters::CHECKS, robot_tiles::CHECKS),
        Role::Server => (servers::CHECKS, &[], server_tiles::CHECKS),
    };
    [sessions, parameters, frames::CHECKS, reliable::CHECKS, tiles, seals::CHECKS]
        .into_iter()
        .flatten()
        .collect()
}
