//! The targets of `tests/src/fuzz.rs`, without the rest of the tests' crate.

#[path = "../../src/fuzz.rs"]
mod targets;

pub use targets::{frames, links, messages, tiles};
