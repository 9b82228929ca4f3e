//! The software of a ubimap robot: from a range scan to shared map tiles, and to the wheels.
//!
//! The modules in the order of the data flow; each imports only those before it:
//!
//! 1. `timing` holds the timeouts and intervals; `trigonometry` is single-precision sine and
//!    cosine;
//! 2. [`sense`]: a depth frame or a lidar's readings become a scan, which waits for its pose;
//! 3. [`locate`]: the pose at the time of the scan, from the server's fixes and odometry;
//! 4. [`map`]: the gate, the selection of new readings, the projection onto `map`, the tiles;
//! 5. [`share`]: tile updates to the server, and the merged map back;
//! 6. [`drive`]: from the map to the wheels;
//! 7. `robot`: [`Robot`] ties them together; it is built from a [`Config`] in a [`Memory`], and the
//!    server can change each [`Parameter`] at run time;
//! 8. [`device`]: drivers of depth sensors and wheels, from and to the bytes of their ports;
//! 9. `machine`: a [`Machine`] is a robot with its devices, behind three ports;
//! 10. [`journal`]: a machine's inputs and outputs, from which its run can be repeated;
//! 11. [`flash`]: the robot's number, key, parameters and boot counter in flash;
//! 12. [`firmware`]: the main loop of an image, over what a board does for it.
//!
//! A scan is one borrowed row of readings: [`Robot::scan`] takes a lidar's readings, or a row of a
//! depth frame, directly from memory. A [`sense::Slicer`] makes the row from a frame that arrives
//! line by line, from several rows, or from a tilted camera.
//!
//! No code here owns a clock, a port, a thread or a heap: time is an argument, and the caller owns
//! the memory. **After every input, drain the outputs until none is left, and call again at
//! `poll_timeout` at the latest**: [`Robot`] shows the complete loop. The same inputs give the same
//! bytes on a Cortex-M and on a PC.
#![no_std]

#[cfg(test)]
extern crate std;

pub mod device;
pub mod drive;
pub mod firmware;
#[cfg(feature = "seals")]
pub mod flash;
pub mod journal;
pub mod locate;
mod machine;
pub mod map;
mod robot;
pub mod sense;
pub mod share;
mod timing;
mod trigonometry;

pub use machine::{Machine, Port};
pub use robot::{
    Arrays, Bounds, Config, ConfigError, LINK_STATE, Memory, Parameter, Part, Robot, Seal,
    Settings, Slices, Statistics, Storage,
};
