//! A marker as it is found in a picture, and the identifier that it shows.

use serde::{Deserialize, Serialize};

/// The identity that a marker shows.
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
    /// Which one it is.
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

/// The colours of colour markers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[expect(missing_docs, reason = "their names say all")]
pub enum Hue {
    Red,
    Yellow,
    Green,
    Cyan,
    Blue,
    Magenta,
}

impl Hue {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Red, Self::Yellow, Self::Green, Self::Cyan, Self::Blue, Self::Magenta];
}
