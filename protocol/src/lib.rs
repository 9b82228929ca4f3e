//! The protocol between ubimap's server and its robots: units, map tiles, messages, frames and
//! link.
//!
//! The modules are layers, in the order in which outgoing data passes through them; each imports
//! only those before it:
//!
//! 1. [`units`] and [`time`]: lengths, angles, poses and times as integers with one unit each, so
//!    that both sides of a link compute the same results;
//! 2. [`checksum`]: the CRC-32 that seals frames and identifies the contents of tiles;
//! 3. [`tile`]: the map. 32 x 32 cells in two bit planes, the state (epoch, version) of a tile, and
//!    the codec for the changes from one state to the next;
//! 4. [`message`]: the messages of both directions, tile updates among them. One table for each
//!    direction ties together number, kind and body;
//! 5. [`frame`]: the envelope around messages. A header, a seal that rejects damaged frames and
//!    those of other sessions, and byte stuffing between delimiters;
//! 6. [`link`]: both ends of a conversation. A handshake that reports every mismatch, reliable
//!    frames (unordered), and the server's time on the robot.
//!
//! The writer of a map change passes it down this list: a [`tile::TileEncoder`] writes into a
//! [`message::Writer`], which a [`link::Endpoint`] offers and puts in a frame. The reader passes it
//! up again, to a [`tile::Replica`]. `SPEC.md` specifies every byte, for other implementations.
//!
//! The crate is sans-IO: it has no clock, port, thread or heap. Time is an argument, and the caller
//! owns the buffers. **After every input (`receive`, or new data to send) call `poll_transmit`
//! until it returns `None`, then call it again at `poll_timeout`.**
#![no_std]

#[cfg(test)]
extern crate std;

pub mod checksum;
pub mod frame;
pub mod link;
pub mod message;
pub mod tile;
pub mod time;
pub mod units;
