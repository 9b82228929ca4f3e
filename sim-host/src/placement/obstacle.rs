//! Obstacles that can hide the floor from a camera: upright prisms.

/// A convex outline seen from above, in `map`, metres.
#[derive(Clone, Debug, PartialEq)]
pub enum Outline {
    /// A circle.
    Disc {
        /// The centre of the circle.
        centre_m: [f64; 2],
        /// The radius of the circle.
        radius_m: f64,
    },
    /// A convex polygon by its corners, counter-clockwise.
    Polygon(Vec<[f64; 2]>),
}

/// An upright prism: a wall, a piece of furniture, or a part of one.
#[derive(Clone, Debug, PartialEq)]
pub struct Obstacle {
    /// The shape seen from above.
    pub outline: Outline,
    /// Height of its lower side above the floor, in metres.
    pub bottom_m: f64,
    /// Height of its upper side above the floor, in metres.
    pub top_m: f64,
}

impl Obstacle {
    /// Whether a horizontal plane at this height, in metres, intersects the prism.
    pub fn spans(&self, height_m: f64) -> bool {
        self.bottom_m <= height_m && height_m < self.top_m
    }

    /// Whether a point of `map` lies within the outline.
    pub fn contains(&self, point: [f64; 2]) -> bool {
        // Clips a segment of length zero.
        self.outline.clip(point, [0.0, 0.0], [0.0, 1.0]).is_some()
    }

    /// Whether the prism hides a point of the floor from an eye (both in `map`, metres; z up).
    ///
    /// The line of sight is `eye + t (floor - eye)`, whose height is `(1 - t) eye_z`. It is between
    /// the prism's bottom and top from `t = 1 - top / eye_z` to `t = 1 - bottom / eye_z`. The prism
    /// hides the floor if that section of the line, seen from above, meets the outline.
    pub fn hides(&self, eye: [f64; 3], floor: [f64; 2]) -> bool {
        let [x, y, z] = eye;
        let from = (1.0 - self.top_m / z).max(0.0);
        let to = (1.0 - self.bottom_m / z).min(1.0);
        from <= to && self.outline.clip([x, y], [floor[0] - x, floor[1] - y], [from, to]).is_some()
    }

    /// `[[x_min, y_min], [x_max, y_max]]` seen from above, in metres.
    pub fn bounds(&self) -> [[f64; 2]; 2] {
        match &self.outline {
            Outline::Disc { centre_m: [x, y], radius_m } => {
                [[x - radius_m, y - radius_m], [x + radius_m, y + radius_m]]
            }
            Outline::Polygon(corners) => {
                let bound = |axis: usize, of: fn(f64, f64) -> f64| {
                    corners.iter().map(|corner| corner[axis]).reduce(of).unwrap_or(0.0)
                };
                [[bound(0, f64::min), bound(1, f64::min)], [bound(0, f64::max), bound(1, f64::max)]]
            }
        }
    }
}

impl Outline {
    /// The part of a line `start + t way` that lies inside the outline, within a range of `t`.
    fn clip(&self, start: [f64; 2], way: [f64; 2], [from, to]: [f64; 2]) -> Option<[f64; 2]> {
        match self {
            Self::Disc { centre_m, radius_m } => {
                let [x, y] = [start[0] - centre_m[0], start[1] - centre_m[1]];
                let apart = x * x + y * y - radius_m * radius_m;
                let squared = way[0] * way[0] + way[1] * way[1];
                if squared == 0.0 {
                    return (apart <= 0.0).then_some([from, to]);
                }
                let half = (x * way[0] + y * way[1]) / squared;
                let root = half * half - apart / squared;
                if root < 0.0 {
                    return None;
                }
                let root = libm::sqrt(root);
                let inside = [(-half - root).max(from), (-half + root).min(to)];
                (inside[0] <= inside[1]).then_some(inside)
            }
            Self::Polygon(corners) => {
                let (mut enter, mut leave) = (from, to);
                for (index, corner) in corners.iter().enumerate() {
                    let next = corners[(index + 1) % corners.len()];
                    let edge = [next[0] - corner[0], next[1] - corner[1]];
                    // A point is inside if it is left of every edge: `at + t rate >= 0`.
                    let at = edge[0] * (start[1] - corner[1]) - edge[1] * (start[0] - corner[0]);
                    let rate = edge[0] * way[1] - edge[1] * way[0];
                    if rate > 0.0 {
                        enter = enter.max(-at / rate);
                    } else if rate < 0.0 {
                        leave = leave.min(-at / rate);
                    } else if at < 0.0 {
                        return None;
                    }
                }
                (enter <= leave && !corners.is_empty()).then_some([enter, leave])
            }
        }
    }
}
