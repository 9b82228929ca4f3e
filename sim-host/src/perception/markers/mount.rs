//! Where a marker is on its robot.

use libm::sincos;
use ubimap_protocol::units::RobotId;

use super::marker::Identifier;

/// How far the middles of a colour marker's head and tail are from its middle, in parts of its
/// side.
const HEAD: f64 = 0.25;

/// How a robot carries a marker.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mount {
    /// Which robot.
    pub robot: RobotId,
    /// The side of a tag's black square, or of a colour marker's cover, in metres.
    pub side_m: f64,
    /// How high above the floor it lies, in metres.
    pub height_m: f64,
    /// Its middle in `base_link`, in metres.
    pub offset_m: [f64; 2],
    /// How far its front edge is turned from the robot's, counter-clockwise in radians.
    pub turn_rad: f64,
}

impl Mount {
    /// Level, its middle over `base_link`, its front ahead.
    pub fn centred(robot: RobotId, side_m: f64, height_m: f64) -> Self {
        Self { robot, side_m, height_m, offset_m: [0.0; 2], turn_rad: 0.0 }
    }

    /// The points of such a marker, in its order, in `base_link` in metres.
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
