//! What runs on a ubimap robot: from a range scan to tiles that all share, and to its wheels.
//!
//! Modules in the order in which data walks through them; each imports only those before it:
//!
//! 1. `timing` names the durations by which something is silent, lost or late; `trigonometry` is what
//!    the robot needs of it, in single precision;
//! 2. [`sense`]: a depth frame or a lidar's readings become a scan, which waits for its pose;
//! 3. [`locate`]: the pose of the moment it was taken, from the server's fixes and odometry;
//! 4. [`map`]: the gate, what is known already, the transform to `map`, the tiles;
//! 5. [`share`]: tile updates to the server, the merged map back;
//! 6. [`drive`]: from the map to the wheels;
//! 7. `robot`: [`Robot`] ties them together under one law, made from one [`Config`], in one
//!    [`Memory`]; [`Parameter`] lists what the server may change of it.
//!
//! A scan is one borrowed row of readings: [`Robot::scan`] takes a lidar's, or a row of a depth
//! frame as it lies in memory. A [`sense::Slicer`] makes the row of a frame that comes line by
//! line, of several rows, or of a camera that is tilted.
//!
//! Nothing here owns a clock, a port, a thread or a heap: time is an argument, memory is the
//! caller's. **After every input drain the outputs until none is left, then come back at
//! `poll_timeout`**: [`Robot`] shows the whole loop. Given the same inputs it gives the same bytes
//! on a Cortex-M and on a PC.
#![no_std]

#[cfg(test)]
extern crate std;

pub mod drive;
pub mod locate;
pub mod map;
mod robot;
pub mod sense;
pub mod share;
mod timing;
mod trigonometry;

pub use robot::{
    Arrays, Bounds, Config, ConfigError, LINK_STATE, Memory, Parameter, Part, Robot, Settings,
    Slices, Statistics, Storage,
};
