//! The checks.

mod frames;
mod reliable;
mod robot_tiles;
mod robots;
mod seals;
mod server_tiles;
mod servers;

use super::check::{Check, Role};

/// The checks for a role, in the order of their numbers from 1 on.
pub fn checks(role: Role) -> Vec<&'static Check> {
    let of_role = match role {
        Role::Robot => [robots::CHECKS, robot_tiles::CHECKS],
        Role::Server => [servers::CHECKS, server_tiles::CHECKS],
    };
    [of_role[0], frames::CHECKS, reliable::CHECKS, of_role[1], seals::CHECKS]
        .into_iter()
        .flatten()
        .collect()
}
