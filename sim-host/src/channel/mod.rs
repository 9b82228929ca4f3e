//! Channels between the server and its robots.
//!
//! - [`fault`]: a wire that loses, repeats, reorders and damages frames, under virtual time.
//! - [`serial`]: a serial port, or a pseudo-terminal that stands for one.
//! - [`wire`]: what a server needs of a port.

pub mod fault;
pub mod serial;
pub mod wire;
