//! The fuzz targets of `tests/src/fuzz.rs`, `tests/src/device_fuzz.rs` and `tests/src/port_fuzz.rs`, without the
//! rest of that crate.

#[path = "../../src/device_fuzz.rs"]
mod device_targets;
#[path = "../../src/port_fuzz.rs"]
mod port_targets;
#[path = "../../src/fuzz.rs"]
mod targets;

pub use device_targets::devices;
pub use port_targets::{overheard, parameters};
pub use targets::{frames, links, messages, tiles};
