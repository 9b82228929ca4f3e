//! A robot outside of the simulation, such as a board or an emulator: the bytes of its three ports lead to the server
//! and to simulated devices in the simulated room.
//!
//! - [`serial_ports`]: serial ports, in real time.
//! - [`in_step`]: a command that runs the robot, in the simulation's time.
//! - [`robot`]: what both lead to.

pub mod in_step;
mod link;
pub mod robot;
pub mod serial_ports;
