//! From a picture to the poses of what carries a marker.
//!
//! A detector ([`TagDetector`], [`detect_colours`]) finds the points of a [`Marker`] in a picture;
//! [`Mount`] says where they are on the robot, and [`locate`] where the robot is then.

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
pub use tag::TagDetector;
