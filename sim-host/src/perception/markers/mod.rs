//! Markers: from a picture to the poses of the robots that carry them.
//!
//! A detector ([`TagDetector`], [`detect_colours`]) finds the points of a [`Marker`] in a picture; a
//! [`Mount`] gives their positions on the robot, and [`locate`] computes the robot's pose.

mod colour;
mod image_region;
mod locate;
mod marker;
mod mount;
#[cfg(test)]
pub(super) mod rendering;
mod tag;
#[cfg(test)]
mod tests;

pub use colour::detect_colours;
pub use image_region::ImageRegion;
pub use locate::{NotThere, Placement, locate};
pub use marker::{Hue, Identifier, Marker};
pub use mount::Mount;
pub use tag::{LEAST_HEIGHT_PX, TagDetector};
