//! From what cameras see to what it is.

mod tracks;

pub use tracks::{Track, Tracks};
