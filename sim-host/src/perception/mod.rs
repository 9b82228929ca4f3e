//! From what cameras see to what it is.

pub mod markers;
pub mod robots;
mod tracks;

pub use tracks::{Track, Tracks};
