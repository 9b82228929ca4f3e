//! Several robots on one floor: who goes where, by which way, and when.
//!
//! | file | from | to |
//! |---|---|---|
//! | `settings` | | what it assumes of robots and rooms, with the reasons |
//! | `situation` | the server | what is known; what it reports |
//! | `ground` | the fused and the coverage layer | where robots can stand, and what nobody sees |
//! | `route` | the ground | the cheapest ways |
//! | `frontiers` | the ground | where there is something to find out |
//! | `approach` | frontiers, ways | the place to look at one from, and what that costs |
//! | `assignment` | those costs | which robot goes to which |
//! | `reservation` | routes | who may drive how far: no meeting, no deadlock |
//! | `evasion` | reservations | standing robots that make way |
//! | `target`, `member` | | what one robot looks at; what is known of it |
//! | `coordinator` | all of these | commands, tick by tick: |
//! | `following` | | whether robots follow their paths |
//! | `exploration` | | frontiers shared out |
//! | `routing` | | routes found and granted |

mod approach;
mod assignment;
mod coordinator;
mod evasion;
mod exploration;
mod following;
mod frontiers;
mod ground;
mod member;
mod reservation;
mod route;
mod routing;
pub mod settings;
mod situation;
mod target;
#[cfg(test)]
mod tests;

pub use coordinator::Coordinator;
pub use settings::Settings;
pub use situation::{GoalError, Notice, Situation, Whereabouts};
