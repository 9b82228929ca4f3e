//! A marker found in a picture, and the identifier that it shows.

use core::fmt;

use serde::{Deserialize, Serialize};

/// The identity that a marker shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Identifier {
    /// The number of an AprilTag of the family 36h11.
    Tag(u16),
    /// The colours of a colour marker's head and tail, which differ (Ahmed et al., 2.2).
    Colours {
        /// The colour of the front disc.
        head: Hue,
        /// The colour of the rear disc.
        tail: Hue,
    },
}

/// A marker in a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Marker {
    /// The identifier that the marker shows.
    pub identifier: Identifier,
    /// Positions in pixels (column, row); the centre of the first pixel is (0, 0). For a tag, the
    /// corners of the black square in the order rear left, rear right, front right, front left; its
    /// upper edge is the front. For a colour marker, the centres of head and tail.
    pub points: Vec<[f64; 2]>,
    /// Standard deviation of each coordinate of a point, in pixels.
    pub noise_px: f64,
}

impl Marker {
    /// The mean of the points.
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
#[expect(missing_docs, reason = "the names are self-explanatory")]
pub enum Hue {
    Red,
    Yellow,
    Green,
    Cyan,
    Blue,
    Magenta,
}

impl Hue {
    /// All colours.
    pub const ALL: [Self; 6] =
        [Self::Red, Self::Yellow, Self::Green, Self::Cyan, Self::Blue, Self::Magenta];
}

impl fmt::Display for Hue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Red => "red",
            Self::Yellow => "yellow",
            Self::Green => "green",
            Self::Cyan => "cyan",
            Self::Blue => "blue",
            Self::Magenta => "magenta",
        })
    }
}
