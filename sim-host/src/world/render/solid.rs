//! Fast intersection of camera rays with an upright prism.
//!
//! [`Room::first_hit`](super::super::room::Room::first_hit) answers the same question for any ray but is
//! much slower; tests compare the two.

use parry2d_f64::glamx::{DVec2, DVec3, Vec2, Vec3};

use super::super::shapes::{Prism, Rim};

/// A prism relative to a camera's optical centre.
pub(super) struct Solid {
    rim: SolidRim,
    low: f32,
    high: f32,
}

enum SolidRim {
    Disc {
        centre: Vec2,
        /// Squared distance of the axis from the optical centre minus the squared radius.
        apart: f32,
        radius: f32,
    },
    /// Outward normal of each side, and its distance along the normal.
    Sides(Vec<(Vec2, f32)>),
}

/// The visible face of a prism.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Face {
    /// From above.
    Top,
    /// From below.
    Bottom,
    /// From the side, with its outward normal.
    Side(Vec2),
}

/// The intersection of a ray with a prism, as a multiple of its direction.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    pub(super) at: f32,
    pub(super) face: Face,
}

impl Solid {
    pub(super) fn new(prism: &Prism, eye: DVec3) -> Self {
        let rim = match prism.footprint.rim() {
            Rim::Disc { centre, radius } => {
                let centre = centre - eye.truncate();
                SolidRim::Disc {
                    centre: centre.as_vec2(),
                    apart: (centre.length_squared() - radius * radius) as f32,
                    radius: radius as f32,
                }
            }
            Rim::Corners(corners) => {
                let next = corners.iter().cycle().skip(1);
                let side = |(from, to): (&DVec2, &DVec2)| {
                    let edge = *to - *from;
                    // Corners are counter-clockwise: outward is to the right of an edge.
                    let normal = -edge.perp().normalize_or_zero();
                    (normal.as_vec2(), normal.dot(*from - eye.truncate()) as f32)
                };
                SolidRim::Sides(corners.iter().zip(next).map(side).collect())
            }
        };
        Self { rim, low: (prism.bottom - eye.z) as f32, high: (prism.top - eye.z) as f32 }
    }

    /// The first intersection of the ray along `way` from the optical centre, if it comes before `limit`,
    /// which is a multiple of `way` like [`Hit::at`].
    #[inline]
    pub(super) fn hit(&self, way: Vec3, limit: f32) -> Option<Hit> {
        let (low, high) = (self.low / way.z, self.high / way.z);
        let level = if way.z < 0.0 { Face::Top } else { Face::Bottom };
        let mut hit = Hit { at: low.min(high), face: level };
        let mut leave = low.max(high).min(limit);
        if hit.at > leave {
            return None;
        }
        let flat = Vec2::new(way.x, way.y);
        match &self.rim {
            SolidRim::Disc { centre, apart, radius } => {
                let (square, along) = (flat.length_squared(), flat.dot(*centre));
                let root = along * along - square * apart;
                if root < 0.0 || (square == 0.0 && *apart > 0.0) {
                    return None;
                }
                let root = root.sqrt();
                let enter = (along - root) / square;
                leave = leave.min((along + root) / square);
                if enter > hit.at {
                    hit = Hit { at: enter, face: Face::Side((flat * enter - *centre) / *radius) };
                }
            }
            SolidRim::Sides(sides) => {
                for &(normal, along) in sides {
                    let speed = flat.dot(normal);
                    let at = along / speed;
                    if speed < 0.0 {
                        if at > hit.at {
                            hit = Hit { at, face: Face::Side(normal) };
                        }
                    } else if speed > 0.0 {
                        leave = leave.min(at);
                    } else if along < 0.0 {
                        return None;
                    }
                }
            }
        }
        (hit.at > 0.0 && hit.at <= leave).then_some(hit)
    }
}
