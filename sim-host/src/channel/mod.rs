//! Channels between the server and its robots.
//!
//! - [`wire`]: the two ends of a link, as traits, and their errors.
//! - [`serial`], [`udp`], [`tcp`]: a serial port or pseudo-terminal, a UDP socket, a TCP listener.
//! - [`unix_socket`], [`socket_file`]: the sockets that other programs of this machine connect to, and their files.
//! - [`process`]: standard input and output of a process.
//! - [`address`]: where a port is, as text.
//! - [`intake`]: the bytes from all ports in one queue, in order of arrival.
//! - [`write_queue`]: writes that never block.
//! - [`fault`]: a wire that loses, repeats, reorders and damages frames, under virtual time.

pub mod address;
pub mod fault;
pub mod intake;
pub mod process;
pub mod serial;
pub mod socket_file;
pub mod tcp;
pub mod udp;
#[cfg(unix)]
pub mod unix_socket;
pub mod wire;
pub mod write_queue;
