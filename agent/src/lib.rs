//! What runs on a ubimap robot: from a range scan to tiles that all share.
//!
//! Modules in the order in which data walks through them; each imports only those before it:
//!
//! 1. `timing` names the durations by which something is silent, lost or late; `trigonometry` is what
//!    the robot needs of it, in single precision;
//! 2. [`sense`]: a depth frame or a lidar's readings become a scan, which waits for its pose;
//! 3. [`locate`]: the pose of the moment it was taken, from the server's fixes and odometry;
//! 4. [`map`]: the gate, what is known already, the transform to `map`, the tiles;
//! 5. [`share`]: tile updates to the server, the merged map back;
//! 6. `config`: what an agent is made from; `parameters`: what the server may change of it
//!    ([`Parameter`]); `statistics`: what it counts;
//! 7. `agent`: [`Agent`] ties them together; `bounds`: what memory it takes ([`Bounds`]);
//! 8. [`drive`]: from the map to the wheels; `pilot`: [`Pilot`] drives an agent's robot by it.
//!
//! A scan is one borrowed row of readings: [`Agent::scan`] takes a lidar's, or a row of a depth
//! frame as it lies in memory. A [`sense::Slicer`] makes the row of a frame that comes line by
//! line, of several rows, or of a camera that is tilted.
//!
//! It owns no clock, no port, no thread and no heap: time is an argument, memory is the caller's.
//! **After every input (`scan`, `odometry`, `receive`, `timeout`) call `poll_transmit` until it
//! has nothing more, then come back at `poll_timeout`.** Given the same inputs it gives the same
//! bytes on a Cortex-M and on a PC.
#![no_std]

#[cfg(test)]
extern crate std;

mod agent;
mod bounds;
mod config;
pub mod drive;
pub mod locate;
pub mod map;
mod parameters;
mod pilot;
pub mod sense;
pub mod share;
mod statistics;
mod timing;
mod trigonometry;

pub use agent::{Agent, LINK_STATE};
pub use bounds::Bounds;
pub use config::{Config, ConfigError, Memory};
pub use parameters::Parameter;
pub use pilot::Pilot;
pub use statistics::Statistics;
