//! Coordination of several robots on one floor: who goes where, on which route, and when.
//!
//! | file | input | content |
//! |---|---|---|
//! | `settings` | | parameters, with the assumptions behind them |
//! | `situation` | the server | the coordinator's input, and its notices |
//! | `drivable` | the user | the floor that robots may use |
//! | `ground` | the fused and the coverage layer | passable and blind ground |
//! | `route` | the ground | cheapest routes |
//! | `frontiers` | the ground | frontiers of unknown ground |
//! | `approach` | frontiers, routes | viewpoints and their costs |
//! | `assignment` | those costs | which robot goes to which frontier |
//! | `reservation` | routes | who may drive how far, without collision or deadlock |
//! | `evasion` | reservations | standing robots that make way |
//! | `target`, `odometry_calibration`, `member` | | the state of one target, and of one robot |
//! | `coordinator` | all of these | commands, in ticks: |
//! | `following` | | checks that robots follow their paths |
//! | `exploration` | | distributes frontiers |
//! | `refuge` | | sends robots back into the cameras' view |
//! | `calibration_drive` | | drives robots to and fro in view to calibrate their odometry |
//! | `second_look` | | sends robots to what blocks the way to frontiers, which may have gone |
//! | `errand` | | says what a robot is doing |
//! | `routing` | | finds and grants routes |

mod approach;
mod assignment;
mod calibration_drive;
mod coordinator;
mod drivable;
mod errand;
mod evasion;
mod exploration;
mod following;
mod frontiers;
mod ground;
mod member;
mod odometry_calibration;
mod refuge;
mod reservation;
mod route;
mod routing;
mod second_look;
pub mod settings;
mod situation;
mod target;
#[cfg(test)]
mod tests;
mod unexplored;

pub use coordinator::Coordinator;
pub use drivable::{Area, AreaError, DrivableFloor};
pub use errand::Errand;
pub use settings::Settings;
pub use situation::{GoalError, Notice, Situation, Whereabouts};
pub use unexplored::{Unexplored, WhyUnexplored};
