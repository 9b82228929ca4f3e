//! Channels between the server and its robots.
//!
//! - [`fault`]: a wire that loses, repeats, reorders and damages frames, under virtual time.
//! - [`serial`]: a serial port, or a pseudo-terminal in its place.
//! - [`wire`]: the trait of byte streams that a server uses.

pub mod fault;
pub mod serial;
pub mod wire;
