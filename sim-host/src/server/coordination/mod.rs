//! Several robots on one floor: who goes where, by which way, and when.
//!
//! | file | from | to |
//! |---|---|---|
//! | `situation` | the server | what is known; what is told |
//! | `ground` | the fused and the coverage layer | where robots can stand, and what nobody sees |
//! | `route` | the ground | the cheapest ways |
//! | `frontiers` | the ground | where there is something to find out |
//! | `approach` | frontiers, ways | from where one is looked at, and what that costs |
//! | `assignment` | those costs | who goes to which |
//! | `reservation` | routes | who may drive how far: no meeting, no deadlock |
//! | `evasion` | reservations | standing robots that make way |
//! | `member` | | what is known of one robot |
//! | `coordinator` | all of these | commands |

mod approach;
mod assignment;
mod coordinator;
mod evasion;
mod exploration;
mod frontiers;
mod ground;
mod member;
mod reservation;
mod route;
mod situation;
#[cfg(test)]
mod tests;

pub use coordinator::{Coordinator, Settings};
pub use situation::{GoalError, Notice, Situation, Whereabouts};
