//! What the end-to-end tests share.

pub mod elf;
pub mod emulator;
