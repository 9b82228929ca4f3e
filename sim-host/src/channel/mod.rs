//! Channels between the server and its robots.
//!
//! - [`fault`]: a wire that loses, repeats, reorders and damages frames, under virtual time.
//! - [`serial`]: a serial port, or a pseudo-terminal that stands for one.

pub mod fault;
pub mod serial;
