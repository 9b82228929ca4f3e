//! The ubimap camera server, its simulated room and its tools.
//!
//! The folders in dataflow order; each imports only from those above it:
//!
//! 1. [`grid`]: occupancy grids, ROS map files, scores.
//! 2. [`camera`]: what a camera reports, and the trait that delivers it.
//! 3. [`perception`]: turns camera frames into cells, people and robot poses.
//! 4. [`mapping`]: camera evidence, robot layers, and the fused and coverage layers.
//! 5. [`server`]: one session per robot, and the coordinator that decides who drives where.
//! 6. [`deployment`]: perception, the server and persistence behind one interface.
//! 7. [`run`]: the drivers of a deployment, one file per `ubimap` command.
//!
//! Beside them: [`placement`] (where to hang cameras), [`calibration`] (where they
//! hang), [`conformance`] (the runner that checks other implementations), [`channel`] (fault channel, serial ports,
//! sockets),
//! [`store`] (layers on disk), [`recording`] (recorded logs and frames), [`report`] (figures and
//! pictures) and [`timing`] (age limits of data). [`world`] is the simulated room, and [`devices`] are
//! simulated sensors and wheels; only [`run`] may import them.
//!
//! # The driving rule
//!
//! Nothing above [`run`] owns a clock, a thread, a port or a file. Time is an argument, inputs are
//! method calls, outputs are polled, and the same inputs give the same outputs. Every driver
//! follows one rule:
//!
//! *After every input, drain the outputs. Then return at the next input, or call `timeout` at
//! `poll_timeout` and drain again.*
//!
//! The drivers differ only in their clocks: simulated time jumps from event to event
//! ([`run::fleet`]), a recording uses its time stamps ([`run::watch`]), and live cameras and robots use
//! the wall clock ([`run::serve`]).

pub mod calibration;
pub mod camera;
pub mod channel;
pub mod conformance;
pub mod deployment;
pub mod devices;
mod files;
pub mod grid;
pub mod mapping;
pub mod perception;
pub mod placement;
pub mod recording;
pub mod report;
mod rounding;
pub mod run;
pub mod server;
pub mod store;
pub mod timing;
pub mod world;

#[cfg(test)]
mod testing;
