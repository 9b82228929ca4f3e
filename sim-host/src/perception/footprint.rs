//! The footprint of a robot.

use ubimap_protocol::units::{Millimetres, Pose};

/// What a robot covers: a rectangle that is aligned with its heading, or a circle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Footprint {
    /// Half the robot's length, in millimetres.
    pub half_length: u16,
    /// Half the robot's width, in millimetres.
    pub half_width: u16,
    /// Whether the robot is a circle, with both halves as its radius. It is masked as the square around it, but needs no
    /// room for corners beside walls.
    pub is_round: bool,
}

impl Default for Footprint {
    /// The default for an unknown robot: 40 x 40 cm.
    fn default() -> Self {
        Self { half_length: 200, half_width: 200, is_round: false }
    }
}

impl Footprint {
    /// The distance of the robot's outermost point from its middle, in metres.
    pub fn radius_m(self) -> f64 {
        if self.is_round { f64::from(self.half_length) / 1000.0 } else { self.corner_m() }
    }

    /// The distance of the rectangle's corners from its middle, in metres.
    pub fn corner_m(self) -> f64 {
        f64::from(self.half_length).hypot(f64::from(self.half_width)) / 1000.0
    }

    /// The cells with sides of `side` whose centres are inside the rectangle at `pose`, or within
    /// `margin` of it.
    pub(crate) fn cells(
        self,
        pose: Pose,
        margin: Millimetres,
        side: Millimetres,
    ) -> impl Iterator<Item = (i32, i32)> {
        let (sin, cos) = libm::sincos(pose.heading.radians());
        let half =
            [self.half_length, self.half_width].map(|it| f64::from(it) + f64::from(margin.0));
        let middle = [pose.x, pose.y].map(|it| f64::from(it.0));
        let side = f64::from(side.0.max(1));
        let radius = half[0].hypot(half[1]);
        let range = move |axis: usize| {
            let cell = |mm: f64| (mm / side).floor() as i32;
            cell(middle[axis] - radius)..=cell(middle[axis] + radius)
        };
        let cells = range(1).flat_map(move |y| range(0).map(move |x| (x, y)));
        cells.filter(move |&(x, y)| {
            let dx = (f64::from(x) + 0.5) * side - middle[0];
            let dy = (f64::from(y) + 0.5) * side - middle[1];
            (dx * cos + dy * sin).abs() <= half[0] && (dy * cos - dx * sin).abs() <= half[1]
        })
    }
}
