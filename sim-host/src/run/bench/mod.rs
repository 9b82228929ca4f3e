//! One robot at a port, without a deployment: the commands that look at it as somebody builds it.
//!
//! | file | content |
//! |---|---|
//! | [`options`] | where the robot is |
//! | [`overheard`] | what a robot tells to whoever listens, before any session |
//! | `opening`, [`session`] | a session with the robot, as that of a server |
//! | `screen`, `picture` | text that is drawn again at its place; a view in characters |
//! | `view`, `motion`, `tilt` | what a robot sees; how it has moved between two views; whether its sensor looks down |
//! | [`quantity`] | parameters in their units |
//! | `diagnosis`, [`findings`] | what is wrong with wheels |
//! | [`ports`], [`monitor`], [`param`], [`sensor`], [`wheels`] | the commands |

mod diagnosis;
pub mod findings;
pub mod monitor;
mod motion;
mod opening;
pub mod options;
pub mod overheard;
pub mod param;
mod picture;
pub mod ports;
pub mod quantity;
mod screen;
pub mod sensor;
pub mod session;
mod tilt;
mod view;
pub mod wheels;
