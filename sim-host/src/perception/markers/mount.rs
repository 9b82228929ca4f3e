//! The mounting of a marker on its robot.

use libm::sincos;
use ubimap_protocol::units::RobotId;

use super::marker::Identifier;

/// Distance from a colour marker's centre to the centres of its head and tail, as a fraction of its side.
const HEAD: f64 = 0.25;

/// A marker on a robot: its size and its pose in `base_link`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mount {
    /// The robot.
    pub robot: RobotId,
    /// The side of a tag's black square, or of a colour marker's cover, in metres.
    pub side_m: f64,
    /// Height above the floor, in metres.
    pub height_m: f64,
    /// Position of the marker's centre in `base_link`, in metres.
    pub offset_m: [f64; 2],
    /// Rotation from the robot's heading to the marker's front, counter-clockwise in radians.
    pub turn_rad: f64,
}

impl Mount {
    /// A marker centred over `base_link` with its front ahead.
    pub fn centred(robot: RobotId, side_m: f64, height_m: f64) -> Self {
        Self { robot, side_m, height_m, offset_m: [0.0; 2], turn_rad: 0.0 }
    }

    /// The points of the marker in `base_link`, in metres, in the order of [`Marker::points`](super::Marker::points).
    pub fn points(&self, identifier: Identifier) -> Vec<[f64; 2]> {
        let (sine, cosine) = sincos(self.turn_rad);
        let placed = |[ahead, left]: [f64; 2]| {
            let (x, y) = (ahead * self.side_m, left * self.side_m);
            let [offset_x, offset_y] = self.offset_m;
            [offset_x + cosine * x - sine * y, offset_y + sine * x + cosine * y]
        };
        let points: &[[f64; 2]] = match identifier {
            Identifier::Tag(_) => &[[-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5], [0.5, 0.5]],
            Identifier::Colours { .. } => &[[HEAD, 0.0], [-HEAD, 0.0]],
        };
        points.iter().copied().map(placed).collect()
    }
}
