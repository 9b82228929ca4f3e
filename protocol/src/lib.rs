//! What travels between ubimap's server and its robots.
#![no_std]

pub mod tile;
pub mod time;
pub mod units;
