//! From a picture to the poses of what carries a marker.
//!
//! A detector ([`TagDetector`], [`detect_colours`]) finds the points of a [`Marker`] in a picture;
//! [`Mount`] says where they are on the robot, and [`locate`] where the robot is then.

mod colour;
mod locate;
mod mount;
#[cfg(test)]
pub(super) mod rendering;
mod tag;
#[cfg(test)]
mod tests;
mod window;

pub use colour::{Hue, detect_colours};
pub use locate::{NotThere, Placement, locate};
pub use mount::Mount;
pub use tag::TagDetector;
pub use window::Window;

/// What a marker says of who carries it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Identifier {
    /// The number of an AprilTag of the family 36h11.
    Tag(u16),
    /// The colours of a marker's head and tail, which differ (Ahmed et al., 2.2).
    Colours {
        /// Ahead.
        head: Hue,
        /// Behind.
        tail: Hue,
    },
}

/// A marker in a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Marker {
    /// What it says.
    pub identifier: Identifier,
    /// Pixels (column, row), the first pixel's centre at (0, 0). Of a tag the corners of the black
    /// square: rear left, rear right, front right, front left, where the upper edge is the front.
    /// Of a colour marker the middles of head and tail.
    pub points: Vec<[f64; 2]>,
    /// The standard deviation of each coordinate of a point, in pixels.
    pub noise_px: f64,
}

impl Marker {
    /// The middle of its points.
    pub fn middle(&self) -> [f64; 2] {
        let mean = |axis: usize| {
            self.points.iter().map(|point| point[axis]).sum::<f64>() / self.points.len() as f64
        };
        [mean(0), mean(1)]
    }
}
