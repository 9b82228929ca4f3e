//! What travels between ubimap's server and its robots.
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
