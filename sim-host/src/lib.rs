//! The ubimap camera server, its simulated room and its tools.
//!
//! Folders in the order in which data walks through them; a folder imports only those above it:
//!
//! 1. [`grid`]: occupancy grids, ROS map files, scores.
//! 2. [`camera`]: what a camera reports, and the door (a trait) through which it comes.
//! 3. [`perception`]: from what cameras see to what it is.
//! 4. [`mapping`]: camera evidence, robot layers, the fused and the coverage layer.
//! 5. [`server`]: a session for each robot.
//!
//! Beside them [`placement`] (where to hang cameras), [`channel`] (fault channel, serial ports), [`store`] (the layers on disk), [`log`] (readers of recorded logs) and
//! [`report`] (figures and pictures). Apart from all, [`world`] is the simulated room; only
//! [`run`], which joins a source, agents, channels and the server, may import it.

pub mod camera;
pub mod channel;
pub mod grid;
pub mod log;
pub mod mapping;
pub mod perception;
pub mod placement;
pub mod report;
pub mod run;
pub mod server;
pub mod store;
pub mod world;

#[cfg(test)]
mod testing;
