//! The fuzz targets of `tests/src/fuzz.rs`, without the rest of that crate.

#[path = "../../src/fuzz.rs"]
mod targets;

pub use targets::{frames, links, messages, tiles};
