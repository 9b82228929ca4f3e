//! One robot at a port, without a deployment: the commands that look at it as somebody builds it.
//!
//! | file | content |
//! |---|---|
//! | [`options`] | where the robot is |
//! | [`overheard`] | what a robot tells to whoever listens, before any session |
//! | [`session`] | a session with the robot, as that of a server |
//! | `screen`, `picture` | text that is drawn again at its place; a view in characters |
//! | `view`, `tilt` | what a robot sees, and how it has moved between two views; whether its sensor looks down |
//! | [`quantity`] | parameters in their units |
//! | `diagnosis` | what is wrong with wheels |
//! | [`ports`], [`monitor`], [`param`], [`sensor`], [`wheels`] | the commands |

mod diagnosis;
pub mod monitor;
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
