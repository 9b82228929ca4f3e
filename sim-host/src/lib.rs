//! The ubimap camera server, its simulated room and its tools.
//!
//! Folders in the order in which data walks through them; a folder imports only those above it:
//!
//! 1. [`grid`]: occupancy grids, ROS map files, scores.
//! 2. [`camera`]: what a camera reports, and the door (a trait) through which it comes.
//! 3. [`perception`]: from what cameras see to what it is.
//! 4. [`mapping`]: camera evidence, robot layers, the fused and the coverage layer.
//! 5. [`server`]: a session for each robot, and who drives where.
//! 6. [`deployment`]: perception, the server and what is kept of it, as one.
//! 7. [`run`]: what drives a deployment, one file for each of `ubimap`'s commands.
//!
//! Beside them [`placement`] (where to hang cameras), [`channel`] (fault channel, serial ports),
//! [`store`] (the layers on disk), [`recording`] (recorded logs and frames), [`report`] (figures and pictures) and [`timing`] (what counts as
//! silent, lost or late). Apart from all, [`world`] is the simulated room; only [`run`] may import
//! it.
//!
//! # The law
//!
//! Nothing above [`run`] owns a clock, a thread, a port or a file. Time is an argument, inputs go
//! in by methods, outputs are polled, and the same inputs give the same outputs. Whoever drives a
//! part of it keeps one law:
//!
//! *After every input drain the outputs until none is left; then come back at the next input, or at
//! `poll_timeout`, call `timeout`, and drain again.*
//!
//! The drivers differ in their clocks alone: the time of a simulation jumps from event to event
//! ([`run::fleet`]), a recording has a clock of its own ([`run::watch`]), and ports need the clock
//! on the wall ([`run::serve`]).

pub mod camera;
pub mod channel;
pub mod deployment;
pub mod grid;
pub mod mapping;
pub mod perception;
pub mod placement;
pub mod recording;
pub mod report;
pub mod run;
pub mod server;
pub mod store;
pub mod timing;
pub mod world;

#[cfg(test)]
mod testing;
