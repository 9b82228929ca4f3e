//! Where the robot is, and where it was when a scan was taken.

mod locator;
mod track;

pub use locator::{Located, Locator, PoseSource};
pub use track::{Around, Track};
