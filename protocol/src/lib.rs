//! What travels between ubimap's server and its robots, and how it arrives.
//!
//! Modules in the order in which data walks through them; each imports only those before it:
//!
//! 1. [`units`] and [`time`]: lengths, angles, poses and moments as integers of one unit each, so that
//!    both sides of a link compute the same;
//! 2. [`checksum`]: the CRC-32 that frames are sealed with and tiles are compared by;
//! 3. [`tile`]: the map. 32 x 32 cells in two bit planes, the state (epoch, version) of a tile, and the
//!    codec of what has changed from one state to the next;
//! 4. [`message`]: what the two sides say to each other, tiles among it. One table for each direction
//!    ties numbers, kinds and bodies together;
//! 5. [`frame`]: the envelope of some messages. A header, a seal by which another session's frames and
//!    damaged ones are told apart, and stuffing between delimiters;
//! 6. [`link`]: both ends of a conversation. A handshake that names every mismatch, frames that arrive
//!    for certain and in any order, and the server's time on the robot.
//!
//! A change of the map goes down this list at its writer (a [`tile::TileEncoder`] writes into a
//! [`message::Writer`], which an [`link::Endpoint`] offers and puts in a frame) and up again at its
//! reader, where a [`tile::Replica`] takes it. `SPEC.md` has the bytes, for other implementations.
//!
//! It owns no clock, no port, no thread and no heap: time is an argument, buffers are the caller's.
//! **After every input (`receive`, or something new to say) call `poll_transmit` until it has nothing
//! more, then come back at `poll_timeout`.**
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
