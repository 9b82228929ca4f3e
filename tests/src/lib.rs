//! What the end-to-end tests share.

pub mod data;
pub mod elf;
pub mod emulator;
pub mod per_ray;
