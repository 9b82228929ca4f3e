//! The cameras of a placement, and what each would see of an empty floor.
//!
//! | paper | here |
//! |---|---|
//! | `alpha`, `beta` | [`CameraModel::horizontal_fov_deg`], [`CameraModel::vertical_fov_deg`] |
//! | `c_i` at `(x_i, y_i)`, `h_i`, `theta` | [`Candidate::position_m`], [`Candidate::heading_deg`] |
//! | `d_i = h_i tan(beta / 2)` | [`CameraModel::depth_m`] |
//! | `w_i = 2 h_i tan(alpha / 2)` | [`CameraModel::width_m`] |

use libm::{cos, sin, tan};

/// The properties that all cameras of a placement share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraModel {
    /// Angle from the left to the right edge of the image, in degrees: the paper's alpha.
    pub horizontal_fov_deg: f64,
    /// Angle from the upper to the lower edge of the image, in degrees: the paper's beta.
    pub vertical_fov_deg: f64,
    /// Maximum distance at which a point is seen, from the optical centre, in metres.
    pub range_m: f64,
}

/// Which floor a camera sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Projection {
    /// The paper's rectangle below a camera that looks straight down. Obstacles and the camera's
    /// range are ignored.
    Paper,
    /// The floor inside a pinhole camera's field of view and within its range, except where walls
    /// or furniture hide it.
    Pinhole,
}

/// A possible pose of a camera: a `c_i` of the paper's `C`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// The optical centre in `map`, in metres; z is the height `h_i`.
    pub position_m: [f64; 3],
    /// Direction in which it faces, counter-clockwise from x, in degrees: the paper's theta. For a
    /// camera that looks straight down, the top of the image is on this side.
    pub heading_deg: f64,
    /// Downward tilt in degrees: 0 is level, 90 straight down.
    pub tilt_deg: f64,
}

impl CameraModel {
    /// The paper's `d_i` of a camera at a height, in metres.
    ///
    /// The paper calls it the depth of the rectangle on the floor, forwards from the camera (`y_i
    /// <= y <= y_i + d_i`), while `w_i` is the whole width. But a camera that looks straight down
    /// sees as far behind as ahead, so `d_i` is half of the depth: [`Footprint`] takes
    /// `-d_i <= y <= d_i`.
    pub fn depth_m(&self, height_m: f64) -> f64 {
        height_m * tan(self.vertical_fov_deg.to_radians() / 2.0)
    }

    /// The same camera with a share of the image's width and height, about its centre.
    pub(super) fn narrowed(&self, share: f64) -> Self {
        let narrowed =
            |fov_deg: f64| 2.0 * libm::atan(share * tan(fov_deg.to_radians() / 2.0)).to_degrees();
        Self {
            horizontal_fov_deg: narrowed(self.horizontal_fov_deg),
            vertical_fov_deg: narrowed(self.vertical_fov_deg),
            ..*self
        }
    }

    /// The paper's `w_i` of a camera at a height, in metres: the whole width of the rectangle.
    pub fn width_m(&self, height_m: f64) -> f64 {
        2.0 * height_m * tan(self.horizontal_fov_deg.to_radians() / 2.0)
    }
}

/// The part of an empty floor that a camera sees.
#[derive(Clone, Copy, Debug)]
pub struct Footprint {
    projection: Projection,
    eye: [f64; 3],
    forward: [f64; 3],
    right: [f64; 3],
    up: [f64; 3],
    /// Half of the image's width and height, as tangents; for the paper's rectangle in metres.
    half: [f64; 2],
    range: f64,
}

impl Footprint {
    /// The footprint of a camera. The paper's projection ignores the tilt.
    pub fn new(projection: Projection, model: &CameraModel, candidate: &Candidate) -> Self {
        let heading = candidate.heading_deg.to_radians();
        // At exactly 90 degrees, rounding errors of sine and cosine would tilt the camera a little.
        let (tilt_sin, tilt_cos) = match candidate.tilt_deg {
            90.0 => (1.0, 0.0),
            tilt => (sin(tilt.to_radians()), cos(tilt.to_radians())),
        };
        let level = [cos(heading), sin(heading)];
        let half = match projection {
            Projection::Paper => {
                let height = candidate.position_m[2];
                [model.width_m(height) / 2.0, model.depth_m(height)]
            }
            Projection::Pinhole => [model.horizontal_fov_deg, model.vertical_fov_deg]
                .map(|degrees| tan(degrees.to_radians() / 2.0)),
        };
        Self {
            projection,
            eye: candidate.position_m,
            forward: [level[0] * tilt_cos, level[1] * tilt_cos, -tilt_sin],
            right: [level[1], -level[0], 0.0],
            up: [level[0] * tilt_sin, level[1] * tilt_sin, tilt_cos],
            half,
            range: model.range_m,
        }
    }

    /// Whether a point of the floor (`map`, metres) is in the footprint.
    pub fn contains(&self, [x, y]: [f64; 2]) -> bool {
        let way = [x - self.eye[0], y - self.eye[1], -self.eye[2]];
        let along = |axis: [f64; 3]| axis[0] * way[0] + axis[1] * way[1] + axis[2] * way[2];
        match self.projection {
            Projection::Paper => {
                let [forward_x, forward_y] = [-self.right[1], self.right[0]];
                let across = self.right[0] * way[0] + self.right[1] * way[1];
                let ahead = forward_x * way[0] + forward_y * way[1];
                across.abs() <= self.half[0] && ahead.abs() <= self.half[1]
            }
            Projection::Pinhole => {
                let depth = along(self.forward);
                depth > 0.0
                    && along(self.right).abs() <= depth * self.half[0]
                    && along(self.up).abs() <= depth * self.half[1]
                    && along(way) <= self.range * self.range
            }
        }
    }

    /// The distance from the point below the camera beyond which no floor is in the footprint, in
    /// metres.
    pub fn reach_m(&self) -> f64 {
        match self.projection {
            Projection::Paper => self.half[0].hypot(self.half[1]),
            Projection::Pinhole => {
                let [.., height] = self.eye;
                libm::sqrt((self.range * self.range - height * height).max(0.0))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MODEL: CameraModel =
        CameraModel { horizontal_fov_deg: 69.0, vertical_fov_deg: 55.0, range_m: 50.0 };

    fn down(heading_deg: f64) -> Candidate {
        Candidate { position_m: [1.0, -2.0, 3.0], heading_deg, tilt_deg: 90.0 }
    }

    #[test]
    fn the_papers_lengths_are_its_formulas() {
        // Computed by hand: 3 tan(27.5 deg) and 6 tan(34.5 deg).
        assert!((MODEL.depth_m(3.0) - 1.561_70).abs() < 1e-5);
        assert!((MODEL.width_m(3.0) - 4.123_69).abs() < 1e-5);
        let flat = CameraModel { horizontal_fov_deg: 90.0, vertical_fov_deg: 90.0, range_m: 9.0 };
        assert!((flat.depth_m(2.5) - 2.5).abs() < 1e-12);
        assert!((flat.width_m(2.5) - 5.0).abs() < 1e-12);
    }

    #[test]
    fn the_rectangle_turns_with_the_camera() {
        // Looking north, 4.12 m lie across from west to east and 3.12 m along.
        let north = Footprint::new(Projection::Paper, &MODEL, &down(90.0));
        assert!(north.contains([1.0 + 2.06, -2.0 + 1.56]) && north.contains([1.0 - 2.06, -3.56]));
        assert!(!north.contains([1.0 + 2.07, -2.0]) && !north.contains([1.0, -2.0 - 1.57]));
        let east = Footprint::new(Projection::Paper, &MODEL, &down(0.0));
        assert!(east.contains([1.0 + 1.56, -2.0 + 2.06]) && !east.contains([1.0 + 1.57, -2.0]));
        let across = Footprint::new(Projection::Paper, &MODEL, &down(45.0));
        let along = 1.56 / 2f64.sqrt();
        assert!(across.contains([1.0 + along, -2.0 + along]));
        assert!(!across.contains([1.0 + 1.57, -2.0 + 1.57]));
    }

    #[test]
    fn a_pinhole_straight_down_sees_the_papers_rectangle() {
        for heading in [0.0, 30.0, 90.0, 217.0] {
            let [paper, pinhole] = [Projection::Paper, Projection::Pinhole]
                .map(|projection| Footprint::new(projection, &MODEL, &down(heading)));
            for index in 0..10_000 {
                let point = [index % 100, index / 100].map(|it| f64::from(it) * 0.06 - 3.0);
                let point = [point[0] + 1.0, point[1] - 2.0];
                assert_eq!(paper.contains(point), pinhole.contains(point), "{point:?}");
            }
        }
    }

    #[test]
    fn a_tilted_pinhole_sees_between_its_edges_and_no_farther_than_its_range() {
        let model = CameraModel { range_m: 6.0, ..MODEL };
        let tilted = Candidate { position_m: [0.0, 0.0, 3.0], heading_deg: 0.0, tilt_deg: 45.0 };
        let footprint = Footprint::new(Projection::Pinhole, &model, &tilted);
        // The camera's rays point 72.5 to 17.5 degrees down: the view starts 3 / tan(72.5 deg) =
        // 0.946 m ahead, and the range ends it at sqrt(36 - 9) = 5.196 m.
        assert!(footprint.contains([0.95, 0.0]) && !footprint.contains([0.94, 0.0]));
        assert!(footprint.contains([5.19, 0.0]) && !footprint.contains([5.20, 0.0]));
        assert!((footprint.reach_m() - 27f64.sqrt()).abs() < 1e-12);
        // On the axis, 3 m ahead and 3 sqrt(2) m away, the half width is tan(34.5 deg) of that
        // distance.
        let half = 3.0 * 2f64.sqrt() * 34.5f64.to_radians().tan();
        assert!(footprint.contains([3.0, half - 0.01]) && !footprint.contains([3.0, half + 0.01]));
    }
}
