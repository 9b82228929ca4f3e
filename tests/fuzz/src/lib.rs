//! The fuzz targets of `tests/src/fuzz.rs` and `tests/src/device_fuzz.rs`, without the rest of that
//! crate.

#[path = "../../src/device_fuzz.rs"]
mod device_targets;
#[path = "../../src/fuzz.rs"]
mod targets;

pub use device_targets::devices;
pub use targets::{frames, links, messages, tiles};
